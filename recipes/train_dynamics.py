"""`playslot train-dynamics run=RUN data.root=DIR`: stage 2, InvDyn and cOCVP on the slots of the run's SAVi."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from playslot_rl.config import ExperimentConfig
from playslot_rl.runs import Run
from playslot_rl.runs.opening import require_parent, run_to_write

if TYPE_CHECKING:
    from playslot_rl.training.pace import Pace
    from playslot_rl.training.stage_dynamics import DynamicsStage


def main(config: ExperimentConfig, pace: Pace | None = None) -> None:
    """Train the dynamics into `RUN/dynamics`; killed, the same command carries on; finished, it says so. `pace` is the
    time that `adopt` gives it; without one it trains as many steps as the config says.
    """
    from playslot_rl.methods.playslot.method import DYNAMICS
    from playslot_rl.training.fit import Part
    from playslot_rl.training.patience import patience_of
    from playslot_rl.training.record import StageRecord, Training, run_stage
    from playslot_rl.training.stage_dynamics import dynamics_on_slots

    run = run_to_write(config)
    slots = Run.of(config, run.folder).own("slots")
    require_parent(config, run, slots, "image_size")
    model = replace(config.model, savi=slots.sizes[0].savi)
    record = StageRecord(
        DYNAMICS,
        run.folder,
        config,
        parents={"slots": slots},
        groups={"model": model},
        ready=partial(run.take, slots),
    )

    def prepare() -> Training:
        own = config.dynamics
        stage = dynamics_on_slots(record, model, own)
        part = Part("dynamics", stage, own, patience=patience_of(own.patience, "mse_slot"), pace=pace)
        read = _actions_read(stage)
        extra = {"episodes": record.data.episodes, **read}
        return Training([part], record.device, said, extra=extra, identity=read)

    def said(metrics: Mapping[str, float]) -> str:
        return (
            f"dynamics: {metrics.get('psnr', float('nan')):.2f} dB on held-out rollouts, "
            f"code perplexity {metrics.get('perplexity', float('nan')):.1f}, {record.folder}"
        )

    run_stage(record, prepare)


def _actions_read(stage: DynamicsStage) -> dict[str, Any]:
    """The range of the actions that are the latents in mode `ground_truth`, after saying it; empty in other modes."""
    from playslot_rl.runtime.processes import here

    source = stage.source
    if not stage.criterion.needs_actions or source.limits is None:
        return {}
    if here().first:
        print(f"dynamics: {source.limits.line(source.require_actions())}", flush=True)
    return {"actions": source.limits.plain()}
