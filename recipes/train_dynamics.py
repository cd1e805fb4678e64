"""`playslot train-dynamics run=RUN data.root=DIR`: stage 2, InvDyn and cOCVP on the slots of the run's SAVi."""

from __future__ import annotations

from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig

if TYPE_CHECKING:
    from playslot_rl.training.pace import Pace


def main(config: ExperimentConfig, pace: Pace | None = None) -> None:
    """Train the dynamics into `RUN/dynamics`; killed, the same command carries on; finished, it says so. `pace` is as
    of train-slots.
    """
    from playslot_rl.methods.playslot.method import DYNAMICS
    from playslot_rl.methods.training import train_stage
    from playslot_rl.runs.opening import run_to_write

    train_stage(DYNAMICS, config, run_to_write(config), pace)
