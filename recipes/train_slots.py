"""`playslot train-slots env=E preset=P data.root=DIR out=RUN`: stage 1, SAVi on unlabelled videos."""

from __future__ import annotations

from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig

if TYPE_CHECKING:
    from playslot_rl.training.pace import Pace


def main(config: ExperimentConfig, pace: Pace | None = None) -> None:
    """Train SAVi into `RUN/slots`; killed, the same command carries on; finished, it says so. `pace` is the time that
    `adopt` gives it; without one it trains as many steps as the config says.
    """
    from playslot_rl.methods.playslot.method import SLOTS
    from playslot_rl.methods.training import train_stage
    from playslot_rl.runs.opening import run_to_write

    train_stage(SLOTS, config, run_to_write(config), pace)
