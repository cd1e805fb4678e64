"""`playslot compare methods=M,... demos=N,... seeds=S,... out=DIR`: methods side by side (docs/how-to/compare.md)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from playslot_rl.config import ExperimentConfig


def main(*configs: ExperimentConfig) -> None:
    """Run what is missing, reuse what is done, write `OUT/comparison.json`, `.md`, `.png` and `.svg`: of one config, or
    of those of `envs=`, each of which has a folder `OUT/TASK`, too.
    """
    from playslot_rl.studies.study import run_study
    from playslot_rl.studies.success.measure import SuccessMeasure
    from playslot_rl.studies.success.tasks import compare_tasks

    first: ExperimentConfig = configs[0]
    whole = [_named(config) for config in configs]
    if first.compare.envs:
        compare_tasks(whole, Path(first.out or f"runs/compare_tasks_{first.preset}"))
    else:
        out = first.out or f"runs/compare_{first.env.full_name}_{first.preset}"
        run_study(SuccessMeasure(replace(whole[0], out=str(Path(out)))))


def _named(config: ExperimentConfig) -> ExperimentConfig:
    """With the runs of world models by their full names."""
    from playslot_rl.runs import Run
    from playslot_rl.studies.success.jobs import world_runs

    run = Run.of(config).name if config.run else ""  # `pretrained` is the task's own
    runs = ",".join(Run.of(replace(config, run=further)).name for further in world_runs(config)[1:])
    return replace(config, run=run, compare=replace(config.compare, runs=runs))
