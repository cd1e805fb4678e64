"""`playslot train-slots env=E preset=P data.root=DIR out=RUN`: stage 1, SAVi on unlabelled videos."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import finished, fixed_keys, open_device, open_run, open_videos, store_config


def main(config: ExperimentConfig) -> None:
    """Train SAVi into `RUN/slots`; killed, the same command carries on; finished, it says so.

    Raises:
        DataError, OutputError, CheckpointError, TrainingError: see `playslot_rl.errors`.
    """
    import torch

    from playslot_rl.modules.savi import SAVi
    from playslot_rl.seeding import derived_seed
    from playslot_rl.storage.checkpoints import checkpoint_folder, save_stage
    from playslot_rl.training.fit import fit
    from playslot_rl.training.runs import load_savi, slots_fingerprint
    from playslot_rl.training.stage_slots import SlotsStage
    from playslot_rl.training.warm_start import warm_start

    run = open_run(config)
    wanted = {"env": {"image_size": config.env.image_size}, "model": {"savi": to_dict(config.model.savi)}}
    if finished(config, run, "slots", {**wanted, "slots": fixed_keys(config.slots)}, {}, config.data.root):
        return
    device = open_device(config)
    source = open_videos(config, config.data.root, "train-slots")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(config.seed, 0, "slots"))
        savi = SAVi(config.model.savi, config.env.image_size).to(device)
    started: dict[str, str] = {}
    if config.slots.start_from:
        warm_start(savi, load_savi(config.slots.start_from, device), config.slots.start_from)
        started = {"started_from": slots_fingerprint(config.slots.start_from)}
    stage = SlotsStage(savi, source, config.slots, validation=config.data.validation, seed=config.seed, device=device)
    identity = {**wanted, "data": source.fingerprint, "data.validation": config.data.validation, **started}
    result = fit(
        stage,
        config.slots,
        run / "slots",
        name="slots",
        seed=config.seed,
        device=device,
        logging=config.logging,
        identity=identity,
        ready=lambda: store_config(config, run),
    )
    save_stage(
        checkpoint_folder(run, "slots"),
        stage="slots",
        modules=stage.modules,
        config={"env": to_dict(config.env), "model": to_dict(config.model), "slots": to_dict(config.slots)},
        data={"train": source.fingerprint},
        parents={},
        metrics=result.metrics,
        steps=result.step,
        seconds=result.seconds,
        extra={
            "episodes": source.episodes,
            "agent_steps": int((source.lengths - 1).sum()),
            "seed": config.seed,
            **started,
        },
    )
    print(f"slots: {result.metrics.get('psnr', float('nan')):.2f} dB on held-out clips, {run / 'slots'}", flush=True)
