"""`playslot train-slots env=E preset=P data.root=DIR out=RUN`: stage 1, SAVi on unlabelled videos."""

from __future__ import annotations

from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.runs import Run
from playslot_rl.runs.opening import run_to_write
from playslot_rl.runtime.devices import open_device

if TYPE_CHECKING:
    from playslot_rl.training.pace import Pace


def main(config: ExperimentConfig, pace: Pace | None = None) -> None:
    """Train SAVi into `RUN/slots`; killed, the same command carries on; finished, it says so. `pace` is as of
    train-dynamics.
    """
    from playslot_rl.evaluation.slots import validation_scores
    from playslot_rl.methods.playslot.method import SLOTS
    from playslot_rl.modules.savi import SAVi
    from playslot_rl.runtime.processes import here
    from playslot_rl.seeds.draws import global_seed
    from playslot_rl.training.fit import Part
    from playslot_rl.training.patience import patience_of
    from playslot_rl.training.record import StageRecord, Training, run_stage
    from playslot_rl.training.stage_slots import SlotsStage, warm_start

    own = config.slots
    record = StageRecord(SLOTS, run_to_write(config).folder, config)

    def prepare() -> Training:
        device, source = open_device(config.device, config.threads), record.data
        with global_seed(config.seed, 0, "slots"):
            savi = SAVi(config.model.savi, config.env.image_size).to(device)
        known = validation_scores(config) if here().first else None
        started: dict[str, str] = {}
        if own.start_from:
            other = Run.open(own.start_from)
            warm_start(savi, other.load_savi(device), own.start_from)
            started = {"started_from": other.stage("slots").fingerprint}
        stage = SlotsStage(savi, record.clips(own.clip_frames), own, known)
        return Training(
            [Part("slots", stage, own, patience=patience_of(own.patience, "mse"), pace=pace)],
            device,
            lambda metrics: f"slots: {metrics.get('psnr', float('nan')):.2f} dB on held-out clips, {record.folder}",
            extra={"episodes": source.episodes, "agent_steps": int((source.lengths - 1).sum()), **started},
            identity=started,
        )

    run_stage(record, prepare)
