"""`playslot train-policy run=RUN data.root=DEMOS`: stage 3, latent policy, slot oracle and action decoder.

`run=pretrained out=RUN` builds on the world model that ships for the task; `demos=N` takes the first N demonstrations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import (
    demo_root,
    finished,
    fixed_keys,
    open_device,
    open_run,
    open_videos,
    parent_run,
    store_config,
)

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from playslot_rl.data.source import EpisodeFrames


def main(config: ExperimentConfig) -> None:
    """Train policy, oracle and decoder into `RUN/policy`; killed, the same command carries on.

    Raises:
        CheckpointError: no finished world model, or the run was begun otherwise.
        DataError: no demonstrations, none with actions, or fewer than `demos` or `behaviour.labelled_demos`.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl.data.demonstrations import (
        first_demonstrations,
        label_demonstrations,
        require_labelled,
        with_copies,
    )
    from playslot_rl.data.shifted import parsed_views
    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.training.checkpoints import checkpoint_folder, require_config, save_stage
    from playslot_rl.training.fit import FitResult, Stage, fit
    from playslot_rl.training.runs import (
        load_world_model,
        require_adoptable,
        use_world_model,
        world_model_checkpoints,
    )
    from playslot_rl.training.seeding import derived_seed
    from playslot_rl.training.stage_behaviour import CloneStage, DecoderStage
    from playslot_rl.world_model import Agent

    run = open_run(config)
    parent = parent_run(config, run)
    parents, model = world_model_checkpoints(parent), config.model
    for checkpoint in parents.values():
        require_adoptable(checkpoint, run)
        env = {"image_size": config.env.image_size, "action_dim": config.env.action_dim}
        require_config(checkpoint, {"env": env})
    trained_as = {
        "model": {"policy": to_dict(model.policy), "action_decoder": to_dict(model.action_decoder)},
        "policy": fixed_keys(config.behaviour),
    }
    if finished(config, run, "policy", trained_as, parents, demo_root(config), config.demos):
        return

    def ready() -> None:
        use_world_model(run, parent)
        store_config(config, run)

    device = open_device(config)
    world = load_world_model(parent, device)
    world.config = replace(world.config, policy=config.model.policy, action_decoder=config.model.action_decoder)
    videos = open_videos(config, demo_root(config), "train-policy")
    source = first_demonstrations(videos, config.demos)
    require_labelled(config.behaviour.labelled_demos, source.episodes)  # before anything is computed
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, "policy"))
        agent = Agent.untrained(world, oracle=config.behaviour.oracle).to(device)
    prints = {name: checkpoint.fingerprint for name, checkpoint in parents.items()}

    def parsed(frames: EpisodeFrames) -> npt.NDArray[np.float32]:
        return slot_cache(frames, world.savi, prints["slots"], config.data.cache, device, config.logging.progress)

    views = parsed_views(videos, source, config.behaviour.shift, config.behaviour.shifted_copies, parsed)
    demos = with_copies([label_demonstrations(world, frames, slots, device) for frames, slots in views])
    lr = config.behaviour.optim.lr
    clone = CloneStage(agent.policy, agent.oracle, demos, config.behaviour)
    sizes = to_dict(world.config)
    identity = {"model": sizes, "data": source.fingerprint, **prints}

    def train(stage: Stage, name: str, steps: int, lr: float) -> FitResult:
        part = run / "policy" if name == "policy" else run / "policy" / name
        return fit(
            stage,
            replace(config.behaviour, steps=steps, optim=replace(config.behaviour.optim, lr=lr)),
            part,
            name=name,
            seed=config.seed,
            device=device,
            logging=config.logging,
            identity=identity,
            ready=ready,
            rate="behaviour.optim.lr" if name == "policy" else "behaviour.decoder_lr",
        )

    cloned = train(clone, "policy", config.behaviour.steps, lr)
    agent.eval()
    decode = DecoderStage(agent.action_decoder, agent.policy, demos, config.behaviour)
    decoded = train(decode, "decoder", config.behaviour.decoder_steps, config.behaviour.decoder_lr)
    save_stage(
        checkpoint_folder(run, "policy"),
        stage="policy",
        modules={**clone.modules, **decode.modules},
        config={"env": to_dict(world.env), "model": sizes, "policy": to_dict(config.behaviour)},
        data={"demos": source.fingerprint},
        parents=prints,
        metrics={**cloned.metrics, **{f"decoder_{key}": value for key, value in decoded.metrics.items()}},
        steps=cloned.step,
        seconds=cloned.seconds + decoded.seconds,
        extra={
            "demos": len(demos.lengths),
            "labelled_demos": config.behaviour.labelled_demos,
            "seed": config.seed,
            "data_root": demo_root(config),
        },
    )
    labelled = config.behaviour.labelled_demos
    print(f"policy: {len(demos.lengths)} demos, {labelled} labelled, {run / 'policy'}", flush=True)
