"""`playslot train-dynamics run=RUN data.root=DIR`: stage 2, InvDyn and cOCVP on the slots of the run's SAVi."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import open_device, open_run, open_videos, parent_run, said


def main(config: ExperimentConfig) -> None:
    """Train the dynamics into `RUN/dynamics`; killed, the same command carries on; finished, it says so.

    Raises:
        CheckpointError: no finished slots stage, or the run was begun otherwise.
        DataError, OutputError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl.data.slot_cache import slot_cache
    from playslot_rl.training.checkpoints import (
        checkpoint_folder,
        load_weights,
        read_stage,
        require_config,
        require_parents,
        run_folder,
        save_stage,
        stage_model,
    )
    from playslot_rl.training.fit import fit
    from playslot_rl.training.seeding import derived_seed
    from playslot_rl.training.stage_dynamics import DynamicsStage
    from playslot_rl.world_model import WorldModel

    parent = run_folder(parent_run(config, open_run(config)))
    run = open_run(config)
    slots = read_stage(checkpoint_folder(parent, "slots"), "slots")
    if parent.resolve() != run.resolve():
        _adopt(slots.path, checkpoint_folder(run, "slots"))
    model = replace(config.model, savi=stage_model(slots)[0].savi)
    sizes = to_dict(model)
    wanted = {"model": {name: sizes[name] for name in ("inverse_dynamics", "predictor")}}
    if said("dynamics", run):
        done = read_stage(checkpoint_folder(run, "dynamics"), "dynamics")
        require_parents(done, {"slots": slots})
        require_config(done, wanted)
        return
    device = open_device(config)
    source = open_videos(config, config.data.root, "train-dynamics")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, "dynamics"))
        world = WorldModel(model, config.env)
    load_weights(slots, {"savi": world.savi})
    world.to(device)
    cached = slot_cache(source, world.savi, slots.fingerprint, config.data.cache, device, progress=True)
    stage = DynamicsStage(
        world, source, cached, config.dynamics, validation=config.data.validation, seed=config.seed, device=device
    )
    result = fit(
        stage,
        config.dynamics,
        run / "dynamics",
        name="dynamics",
        seed=config.seed,
        device=device,
        logging=config.logging,
        identity={**wanted, "slots": slots.fingerprint, "data": source.fingerprint},
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


def _adopt(source: Path, target: Path) -> None:
    """Copy a finished parent stage into the run that builds on it, so that the run is whole."""
    import shutil

    from playslot_rl.training.atomic import explain_write_errors, replace_dir, temporary_name

    if target.exists():
        return
    temporary = temporary_name(target)
    with explain_write_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copytree(source, temporary)
        replace_dir(temporary, target)
