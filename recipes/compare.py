"""`playslot compare methods=M,... demos=N,... seeds=S,... out=DIR`: methods side by side (docs/how-to/compare.md)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from playslot_rl.config import ExperimentConfig


def main(config: ExperimentConfig) -> None:
    """Run what is missing, reuse what is done, write `OUT/comparison.json`, `.md`, `.png` and `.svg`."""
    from playslot_rl.runs import Run
    from playslot_rl.studies.study import run_study
    from playslot_rl.studies.success.jobs import world_runs
    from playslot_rl.studies.success.measure import SuccessMeasure

    out = config.out or f"runs/compare_{config.env.full_name}_{config.preset}"
    run = Run.of(config).name if config.run else ""  # `pretrained` is the task's own
    runs = ",".join(Run.of(replace(config, run=further)).name for further in world_runs(config)[1:])
    compare = replace(config.compare, runs=runs)
    run_study(SuccessMeasure(replace(config, out=str(Path(out)), run=run, compare=compare)))
