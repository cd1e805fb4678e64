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
    from playslot_rl.training.record import StageRecord


def online_record(
    config: ExperimentConfig,
    own: OnlineConfig,
    run: Path,
    name: str,
    *,
    ready: Callable[[], None] = lambda: None,
    parents: Mapping[str, StageCheckpoint] | None = None,
) -> StageRecord:
    """The record of a method whose part of the config is `own`; it learns from no data set."""
    from playslot_rl.training.record import StageRecord

    return StageRecord(
        name,
        run,
        config,
        stored={"env": to_dict(config.env), name: to_dict(own)},
        counts=("env",),
        identity={"render": to_dict(config.render)},
        parents=parents or {},
        role="",
        ready=ready,
    )


def train_and_save(
    record: StageRecord,
    own: OnlineConfig,
    learner: Learner,
    modules: Mapping[str, nn.Module],
    device: torch.device,
    prior_steps: int = 0,
) -> None:
    """Train a method online and save it as its record says.

    Args:
        record: what the stage is.
        own: the method's part of the config.
        learner: its modules on `device`.
        modules: what the stage's checkpoint holds.
        device: the learner's.
        prior_steps: agent steps of the data of the SAVi it builds on.

    Raises:
        CheckpointError, OutputError, TrainingError, KeyboardInterrupt: as `train_online`.
    """
    from playslot_rl.baselines.online.loop import train_online
    from playslot_rl.config.methods import METHODS
    from playslot_rl.storage.atomic import write_bytes
    from playslot_rl.visualization.charts import learning_chart
    from playslot_rl.visualization.palette import DARK, LIGHT

    name = record.name
    state, _ = train_online(learner, own, record, title=METHODS[name].title, device=device, prior_steps=prior_steps)
    for theme in (LIGHT, DARK):
        chart = learning_chart({name: state.curve}, state.random, theme)
        write_bytes(record.folder / f"curve_{theme.name}.png", chart)
    extra = {
        "env_steps": state.step + prior_steps,
        "savi_steps": prior_steps,
        "episodes": state.episodes,
        "random_policy": state.random,
        "parameters": sum(p.numel() for module in modules.values() for p in module.parameters()),
    }
    record.save(modules, state.metrics, state.updates, state.seconds, extra)
    last, random, prior = state.curve[-1], state.random, f" and {prior_steps} of SAVi's data" if prior_steps else ""
    print(
        f"{name}: {state.step} agent steps{prior}, {state.updates} updates; development episodes: return "
        f"{last['return_mean']:.2f} (random {random['return_mean']:.2f}), success {100 * last['success_rate']:.0f} % "
        f"(random {100 * random['success_rate']:.0f} %); {record.folder}",
        flush=True,
    )
