"""What the recipes of the methods that learn by acting share: training, the checkpoint, the closing line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, to_dict

if TYPE_CHECKING:
    import torch
    from torch import nn

    from playslot_rl.baselines.online.learner import Learner
    from playslot_rl.config.baselines import OnlineConfig
    from playslot_rl.storage.checkpoints import StageCheckpoint


def train_and_save(
    config: ExperimentConfig,
    own: OnlineConfig,
    run: Path,
    name: str,
    learner: Learner,
    modules: Mapping[str, nn.Module],
    *,
    device: torch.device,
    ready: Callable[[], None],
    slots: StageCheckpoint | None = None,
    prior_steps: int = 0,
) -> None:
    """Train a method online and save it as the stage `name` of `run`.

    Args:
        config: of the command.
        own: the method's part of it.
        run: run folder.
        name: the method and its stage.
        learner: its modules on `device`.
        modules: what the stage's checkpoint holds.
        device: the learner's.
        ready: called before anything is played, when nothing speaks against it.
        slots: the SAVi it builds on, if it does.
        prior_steps: agent steps of that SAVi's data.

    Raises:
        CheckpointError, OutputError, TrainingError, KeyboardInterrupt: as `train_online`.
    """
    from playslot_rl.baselines.online.loop import train_online
    from playslot_rl.config.methods import METHODS
    from playslot_rl.storage.checkpoints import checkpoint_folder, save_stage

    parents = {} if slots is None else {"slots": slots.fingerprint}
    result = train_online(
        learner,
        own,
        config,
        run / name,
        name=name,
        title=METHODS[name].title,
        device=device,
        identity=parents,
        ready=ready,
        prior_steps=prior_steps,
    )
    state, random = result.state, result.random
    save_stage(
        checkpoint_folder(run, name),
        stage=name,
        modules=modules,
        config={"env": to_dict(config.env), name: to_dict(own)},
        data={},
        parents=parents,
        metrics=state.metrics,
        steps=state.updates,
        seconds=state.seconds,
        extra={
            "env_steps": state.step + prior_steps,
            "savi_steps": prior_steps,
            "episodes": state.episodes,
            "seed": config.seed,
            "random_policy": random,
            "parameters": sum(p.numel() for module in modules.values() for p in module.parameters()),
        },
    )
    last, prior = state.curve[-1], f" and {prior_steps} of SAVi's data" if prior_steps else ""
    print(
        f"{name}: {state.step} agent steps{prior}, {state.updates} updates; development episodes: return "
        f"{last['return_mean']:.2f} (random {random['return_mean']:.2f}), success {100 * last['success_rate']:.0f} % "
        f"(random {100 * random['success_rate']:.0f} %); {run / name}",
        flush=True,
    )
