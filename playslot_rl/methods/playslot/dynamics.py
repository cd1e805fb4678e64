"""Training of inverse dynamics and predictor on the slots of a frozen SAVi."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from playslot_rl.config import DynamicsStageConfig
from playslot_rl.runtime.processes import here
from playslot_rl.training.fit import Part
from playslot_rl.training.patience import patience_of
from playslot_rl.training.record import StageRecord
from playslot_rl.training.run_stage import Training
from playslot_rl.training.stage_dynamics import DynamicsStage, dynamics_on_slots


def training(record: StageRecord) -> Training:
    own: DynamicsStageConfig = record.config.dynamics
    stage = dynamics_on_slots(record, record.groups["model"], own)
    read = _actions_read(stage)

    def said(metrics: Mapping[str, float]) -> str:
        return (
            f"dynamics: {metrics.get('psnr', float('nan')):.2f} dB on {stage.clips.validated} rollouts, "
            f"code perplexity {metrics.get('perplexity', float('nan')):.1f}, {record.folder}"
        )

    part = Part("dynamics", stage, own, patience=patience_of(own.patience, "mse_slot"), pace=record.pace)
    extra = {**record.seen(stage.clips.frames), **read}
    return Training([part], record.device, said, extra=extra, identity=read)


def _actions_read(stage: DynamicsStage) -> dict[str, Any]:
    """The range of the actions that are the latents in mode `ground_truth`, after saying it; empty in other modes."""
    source = stage.source
    if not stage.criterion.needs_actions or source.limits is None:
        return {}
    if here().first:
        print(f"dynamics: {source.limits.line(source.require_actions())}", flush=True)
    return {"actions": source.limits.plain()}
