"""`playslot train-dynamics run=RUN data.root=DIR`: stage 2, InvDyn and cOCVP on the slots of the run's SAVi."""

from __future__ import annotations

from dataclasses import replace

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import finished, fixed_keys, open_device, open_run, open_videos, parent_run, store_config


def main(config: ExperimentConfig) -> None:
    """Train the dynamics into `RUN/dynamics`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots stage, or the run was begun otherwise.
        DataError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.seeding import derived_seed
    from playslot_rl.storage.checkpoints import checkpoint_folder, load_weights, read_stage, require_config, save_stage
    from playslot_rl.training.fit import fit
    from playslot_rl.training.runs import adopt_stage, require_adoptable, run_folder, stage_model
    from playslot_rl.training.stage_dynamics import DynamicsStage
    from playslot_rl.world_model import WorldModel

    run = open_run(config)
    parent = run_folder(parent_run(config, run))
    slots = read_stage(checkpoint_folder(parent, "slots"), "slots")
    require_config(slots, {"env": {"image_size": config.env.image_size}})
    require_adoptable(slots, run)
    model = replace(config.model, savi=stage_model(slots)[0].savi)
    sizes = to_dict(model)
    wanted = {"model": {name: sizes[name] for name in ("inverse_dynamics", "predictor")}}
    trained_as = {**wanted, "dynamics": fixed_keys(config.dynamics)}
    if finished(config, run, "dynamics", trained_as, {"slots": slots}, config.data.root):
        return

    def ready() -> None:
        adopt_stage(slots, run)
        store_config(config, run)

    device = open_device(config)
    source = open_videos(config, config.data.root, "train-dynamics")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, "dynamics"))
        world = WorldModel(model, config.env)
    load_weights(slots, {"savi": world.savi})
    world.to(device)
    cached = slot_cache(source, world.savi, slots.fingerprint, config.data.cache, device, config.logging.progress)
    stage = DynamicsStage(
        world, source, cached, config.dynamics, validation=config.data.validation, seed=config.seed, device=device
    )
    prints = {"slots": slots.fingerprint, "data": source.fingerprint}
    result = fit(
        stage,
        config.dynamics,
        run / "dynamics",
        name="dynamics",
        seed=config.seed,
        device=device,
        logging=config.logging,
        identity={**wanted, **prints, "data.validation": config.data.validation},
        ready=ready,
    )
    save_stage(
        checkpoint_folder(run, "dynamics"),
        stage="dynamics",
        modules=stage.modules,
        config={"env": to_dict(config.env), "model": sizes, "dynamics": to_dict(config.dynamics)},
        data={"train": source.fingerprint},
        parents={"slots": slots.fingerprint},
        metrics=result.metrics,
        steps=result.step,
        seconds=result.seconds,
        extra={"episodes": source.episodes, "seed": config.seed},
    )
    print(
        f"dynamics: {result.metrics.get('psnr', float('nan')):.2f} dB on held-out rollouts, "
        f"code perplexity {result.metrics.get('perplexity', float('nan')):.1f}, {run / 'dynamics'}",
        flush=True,
    )
