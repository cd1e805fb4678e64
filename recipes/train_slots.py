"""`playslot train-slots env=E preset=P data.root=DIR out=RUN`: stage 1, SAVi on unlabelled videos."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.recipes.run import open_device, open_run, open_videos, store_config

if TYPE_CHECKING:
    from playslot_rl.training.record import StageRecord, Training


def main(config: ExperimentConfig) -> None:
    """Train SAVi into `RUN/slots`; killed, the same command carries on; finished, it says so.

    Raises:
        DataError, OutputError, CheckpointError, TrainingError: see `playslot_rl.errors`.
    """
    from playslot_rl.training.record import StageRecord, run_stage

    run = open_run(config)
    record = StageRecord(
        "slots",
        run,
        config,
        stored={"env": to_dict(config.env), "model": to_dict(config.model), "slots": to_dict(config.slots)},
        counts=("env.image_size", "model.savi"),
        identity={"data.validation": config.data.validation},
        open_data=partial(open_videos, config, config.data.root, "train-slots"),
        named=bool(config.data.root),
        ready=partial(store_config, config, run),
    )
    run_stage(record, partial(_training, config, record))


def _training(config: ExperimentConfig, record: StageRecord) -> Training:
    from playslot_rl.modules.savi import SAVi
    from playslot_rl.seeding import global_seed
    from playslot_rl.training.fit import Part
    from playslot_rl.training.record import Training
    from playslot_rl.training.runs import load_savi, slots_fingerprint
    from playslot_rl.training.stage_slots import SlotsStage
    from playslot_rl.training.warm_start import warm_start

    device, source, own = open_device(config), record.data, config.slots
    with global_seed(config.seed, 0, "slots"):
        savi = SAVi(config.model.savi, config.env.image_size).to(device)
    started: dict[str, str] = {}
    if own.start_from:
        warm_start(savi, load_savi(own.start_from, device), own.start_from)
        started = {"started_from": slots_fingerprint(own.start_from)}
    stage = SlotsStage(savi, source, own, validation=config.data.validation, seed=config.seed, device=device)
    return Training(
        [Part("slots", stage, own)],
        device,
        lambda metrics: f"slots: {metrics.get('psnr', float('nan')):.2f} dB on held-out clips, {record.folder}",
        extra={"episodes": source.episodes, "agent_steps": int((source.lengths - 1).sum()), **started},
        identity=started,
    )
