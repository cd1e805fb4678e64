"""`playslot train-policy run=RUN data.root=DEMOS`: stage 3, latent policy, slot oracle and action decoder.

`run=pretrained out=RUN` builds on the world model that ships for the task; `demos=N` takes the first N demonstrations.
"""

from __future__ import annotations

from playslot_rl.config import ExperimentConfig


def main(config: ExperimentConfig) -> None:
    """Train policy, oracle and decoder into `RUN/policy`; killed, the same command carries on."""
    from playslot_rl.methods.playslot.method import POLICY
    from playslot_rl.methods.training import train_stage
    from playslot_rl.runs.opening import run_to_write

    train_stage(POLICY, config, run_to_write(config))
