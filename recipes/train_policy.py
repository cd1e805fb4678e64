"""`playslot train-policy run=RUN data.root=DEMOS`: stage 3, latent policy, slot oracle and action decoder.

`run=pretrained out=RUN` builds on the world model that ships for the task; `demos=N` takes the first N demonstrations.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import (
    demo_root,
    demonstration_views,
    finished,
    fixed_keys,
    open_device,
    open_run,
    open_videos,
    parent_run,
    store_config,
)

if TYPE_CHECKING:
    import torch

    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.training.fit import FitResult, Stage
    from playslot_rl.world_model import Agent, WorldModel


def main(config: ExperimentConfig) -> None:
    """Train policy, oracle and decoder into `RUN/policy`; killed, the same command carries on.

    Raises:
        CheckpointError: no finished world model, or the run was begun otherwise.
        DataError: no demonstrations, none with actions, or fewer than `demos` or `behaviour.labelled_demos`.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.data.demonstrations import (
        first_demonstrations,
        label_demonstrations,
        require_labelled,
        with_copies,
    )
    from playslot_rl.storage.checkpoints import checkpoint_folder, save_stage
    from playslot_rl.training.fit import fit
    from playslot_rl.training.runs import use_world_model
    from playslot_rl.training.stage_behaviour import CloneStage, DecoderStage

    run = open_run(config)
    parent = parent_run(config, run)
    parents = _world_model_of(config, parent, run)
    if finished(config, run, "policy", _trained_as(config), parents, demo_root(config), config.demos):
        return

    def ready() -> None:
        use_world_model(run, parent)
        store_config(config, run)

    device = open_device(config)
    videos = open_videos(config, demo_root(config), "train-policy")
    source = first_demonstrations(videos, config.demos)
    require_labelled(config.behaviour.labelled_demos, source.episodes)  # before anything is computed
    world, agent = _untrained(config, parent, device)
    prints = {name: checkpoint.fingerprint for name, checkpoint in parents.items()}
    views = demonstration_views(config, videos, source, world.savi, prints["slots"])
    demos = with_copies([label_demonstrations(world, frames, slots, device) for frames, slots in views])
    sizes = to_dict(world.config)
    behaviour = config.behaviour

    def train(stage: Stage, folder: Path, steps: int, lr: float) -> FitResult:
        return fit(
            stage,
            replace(behaviour, steps=steps, optim=replace(behaviour.optim, lr=lr)),
            folder,
            name=folder.name,
            seed=config.seed,
            device=device,
            logging=config.logging,
            identity={"model": sizes, "data": source.fingerprint, **prints},
            ready=ready,
            rate="behaviour.optim.lr" if stage is clone else "behaviour.decoder_lr",
        )

    clone = CloneStage(agent.policy, agent.oracle, demos, behaviour)
    cloned = train(clone, run / "policy", behaviour.steps, behaviour.optim.lr)
    agent.eval()
    decode = DecoderStage(agent.action_decoder, agent.policy, demos, behaviour)
    decoded = train(decode, run / "policy" / "decoder", behaviour.decoder_steps, behaviour.decoder_lr)
    save_stage(
        checkpoint_folder(run, "policy"),
        stage="policy",
        modules={**clone.modules, **decode.modules},
        config={"env": to_dict(world.env), "model": sizes, "policy": to_dict(behaviour)},
        data={"demos": source.fingerprint},
        parents=prints,
        metrics={**cloned.metrics, **{f"decoder_{key}": value for key, value in decoded.metrics.items()}},
        steps=cloned.step,
        seconds=cloned.seconds + decoded.seconds,
        extra={
            "demos": len(demos.lengths),
            "labelled_demos": behaviour.labelled_demos,
            "seed": config.seed,
            "data_root": demo_root(config),
        },
    )
    print(f"policy: {len(demos.lengths)} demos, {behaviour.labelled_demos} labelled, {run / 'policy'}", flush=True)


def _world_model_of(config: ExperimentConfig, parent: str | Path, run: Path) -> dict[str, StageCheckpoint]:
    """The world model's checkpoints: whole, of this task's frames and actions, and fit for `run`."""
    from playslot_rl.storage.checkpoints import require_config
    from playslot_rl.training.runs import require_adoptable, world_model_checkpoints

    parents = world_model_checkpoints(parent)
    for checkpoint in parents.values():
        require_adoptable(checkpoint, run)
        env = {"image_size": config.env.image_size, "action_dim": config.env.action_dim}
        require_config(checkpoint, {"env": env})
    return parents


def _trained_as(config: ExperimentConfig) -> dict[str, object]:
    """Settings that a finished stage must share."""
    return {
        "model": {"policy": to_dict(config.model.policy), "action_decoder": to_dict(config.model.action_decoder)},
        "policy": fixed_keys(config.behaviour),
    }


def _untrained(config: ExperimentConfig, parent: str | Path, device: torch.device) -> tuple[WorldModel, Agent]:
    """The frozen world model, and fresh policy, oracle and decoder on top of it."""
    import torch

    from playslot_rl.seeding import derived_seed
    from playslot_rl.training.runs import load_world_model
    from playslot_rl.world_model import Agent

    world = load_world_model(parent, device)
    world.config = replace(world.config, policy=config.model.policy, action_decoder=config.model.action_decoder)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, "policy"))
        return world, Agent.untrained(world, oracle=config.behaviour.oracle).to(device)
