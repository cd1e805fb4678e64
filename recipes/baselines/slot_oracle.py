"""`playslot train-baseline method=slot_oracle run=WORLD data.demos=DEMOS out=DIR`: clone real actions from slots.

Sizes are `model.policy`, the schedule is `behaviour`, as for PlaySlot's policy.
"""

from __future__ import annotations

from dataclasses import replace

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


def main(config: ExperimentConfig) -> None:
    """Train the oracle into `OUT/slot_oracle`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots in `run`, or `out` was begun otherwise.
        DataError: fewer than `demos` demonstrations, or none with actions.
        OutputError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl.baselines.oracles.slot import NAME
    from playslot_rl.data.demonstrations import first_demonstrations, real_actions, transitions
    from playslot_rl.modules.policy import LatentPolicy
    from playslot_rl.seeding import derived_seed
    from playslot_rl.storage.checkpoints import checkpoint_folder, read_stage, require_config, save_stage
    from playslot_rl.training.fit import fit
    from playslot_rl.training.runs import (
        load_savi,
        require_adoptable,
        stage_model,
        use_world_model,
        world_model_folder,
    )
    from playslot_rl.training.stage_behaviour import oracle_stage

    run = open_run(config)
    parent = parent_run(config, run)
    slots = read_stage(checkpoint_folder(world_model_folder(parent), "slots"), "slots")
    require_adoptable(slots, run)
    require_config(slots, {"env": {"image_size": config.env.image_size}})
    policy = {"policy": to_dict(config.model.policy)}
    parents, demos = {"slots": slots}, demo_root(config)
    if finished(config, run, NAME, {"model": policy, NAME: fixed_keys(config.behaviour)}, parents, demos, config.demos):
        return

    def ready() -> None:
        use_world_model(run, parent)
        store_config(config, run)

    device = open_device(config)
    videos = open_videos(config, demos, "train-baseline")
    source = first_demonstrations(videos, config.demos)
    moves = transitions(source)
    actions = real_actions(source, moves.rows, config.env.action_dim).to(device)
    savi = load_savi(parent, device)
    model = replace(config.model, savi=stage_model(slots)[0].savi)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, NAME))
        oracle = LatentPolicy(model.policy, model.savi.slot_dim, config.env.action_dim).to(device)
    views = demonstration_views(config, videos, source, savi, slots.fingerprint)
    inputs = torch.cat([torch.from_numpy(cached[moves.rows]) for _, cached in views])
    stage = oracle_stage(oracle, inputs.to(device), actions.repeat(len(views), 1), config.behaviour)
    result = fit(
        stage,
        config.behaviour,
        run / NAME,
        name=NAME,
        seed=config.seed,
        device=device,
        logging=config.logging,
        identity={"model": policy, "data": source.fingerprint, "slots": slots.fingerprint},
        ready=ready,
        rate="behaviour.optim.lr",
    )
    save_stage(
        checkpoint_folder(run, NAME),
        stage=NAME,
        modules=stage.modules,
        config={"env": to_dict(config.env), "model": to_dict(model), NAME: to_dict(config.behaviour)},
        data={"demos": source.fingerprint},
        parents={"slots": slots.fingerprint},
        metrics=result.metrics,
        steps=result.step,
        seconds=result.seconds,
        extra={"demos": len(moves.lengths), "labelled_demos": len(moves.lengths), "seed": config.seed},
    )
    print(f"{NAME}: {len(moves.lengths)} demos, all labelled, {run / NAME}", flush=True)
