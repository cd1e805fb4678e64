"""`playslot compare methods=M,... demos=N,... seeds=S,... out=DIR`: methods side by side (docs/how-to/compare.md)."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compare import CompareConfig
from playslot_rl.errors import PlaySlotError


def main(config: ExperimentConfig) -> None:
    """Run what is missing, reuse what is done, write `OUT/comparison.json`, `.md`, `.png` and `.svg`.

    Raises:
        ConfigError, DataError, CheckpointError: what is asked for cannot be compared; before anything is computed.
        PlaySlotError: a job failed; the others have finished, and the table says so.
        KeyboardInterrupt: Ctrl-C; the same command carries on.
    """
    from playslot_rl.evaluation.success import DEFAULT_EPISODES
    from playslot_rl.recipes import compare_data
    from playslot_rl.recipes.run import parent_run
    from playslot_rl.studies.launch import comparison_lock, open_comparison, run_due
    from playslot_rl.studies.plan import check_comparison, job_config, job_record, jobs
    from playslot_rl.studies.report import Comparison

    began, wanted = time.monotonic(), config.compare
    out = Path(config.out or f"runs/compare_{config.env.name}_{config.preset}")
    run = parent_run(config, out) if config.run else ""  # `pretrained` is the task's own
    config = replace(config, episodes=config.episodes or DEFAULT_EPISODES, out=str(out), run=run)
    check_comparison(config)
    open_comparison(out)
    config = compare_data.check_data(config, out)
    with comparison_lock(out):
        config = compare_data.prepare(config, out)
        plain = replace(
            config, compare=CompareConfig(evaluation_seed=wanted.evaluation_seed, processes=wanted.processes)
        )
        parents, records = compare_data.Parents(config, out), {}
        for job in jobs(config, out):
            own = job_config(plain, job, config.run)
            records[job] = job_record(job, own, parents.of(job))
        report = Comparison(config, out, records, began)
        report.references()
        run_due("compare", report, wanted.launcher, wanted.hydra)
        failed = report.write()
    print(report.table(), flush=True)
    print(f"compare: {time.monotonic() - began:.0f} s, {out / 'comparison.md'}", flush=True)
    if failed:
        names = ", ".join(row["name"] for row in failed)
        raise PlaySlotError(
            f"compare: {len(failed)} of {len(records)} jobs failed ({names}), the others finished; "
            f"{out / 'comparison.md'} says why, and the same command tries them again"
        )
