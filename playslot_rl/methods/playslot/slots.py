"""Training of SAVi on unlabelled videos."""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig
from playslot_rl.evaluation.objects import validation_scores
from playslot_rl.modules.savi import SAVi
from playslot_rl.runs import Run
from playslot_rl.runtime.processes import here
from playslot_rl.seeds.draws import global_seed
from playslot_rl.training.patience import patience_of
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training, on_clips
from playslot_rl.training.stage_slots import SlotsStage, warm_start


def training(record: StageRecord) -> Training:
    """A fresh SAVi, or one that begins with another's weights (`slots.start_from`)."""
    config: ExperimentConfig = record.config
    own, device, source = config.slots, record.device, record.data
    with global_seed(config.seed, 0, "slots"):
        savi = SAVi(config.model.savi, config.env.image_size).to(device)
    known = validation_scores(config) if here().first else None
    started: dict[str, str] = {}
    if own.start_from:
        other = Run.open(own.start_from)
        warm_start(savi, other.load_savi(device), own.start_from)
        started = {"started_from": other.stage("slots").fingerprint}
    stage = SlotsStage(savi, record.clips(own.clip_frames), own, known)
    extra = {**record.seen(own.clip_frames), "agent_steps": int((source.lengths - 1).sum())}
    return on_clips(
        record, stage, own, "slots", patience=patience_of(own.patience, "mse"), extra=extra, identity=started
    )
