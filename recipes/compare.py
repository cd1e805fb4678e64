"""`playslot compare methods=M,... demos=N,... seeds=S,... out=DIR`: methods side by side (docs/baselines.md)."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from playslot_rl.config import ExperimentConfig
from playslot_rl.config.compare import CompareConfig
from playslot_rl.errors import OutputError, PlaySlotError

if TYPE_CHECKING:
    from playslot_rl.comparison.report import Comparison


def main(config: ExperimentConfig) -> None:
    """Run what is missing, reuse what is done, write `OUT/comparison.json`, `.md`, `.png` and `.svg`.

    Raises:
        ConfigError, DataError, CheckpointError: what is asked for cannot be compared; before anything is computed.
        PlaySlotError: a job failed; the others have finished, and the table says so.
        KeyboardInterrupt: Ctrl-C; the same command carries on.
    """
    from playslot_rl.comparison.launch import comparison_lock
    from playslot_rl.comparison.plan import check_comparison, job_config, job_record, jobs
    from playslot_rl.comparison.report import Comparison
    from playslot_rl.evaluation.success import DEFAULT_EPISODES
    from playslot_rl.recipes import compare_data
    from playslot_rl.recipes.run import parent_run

    began = time.monotonic()
    out = Path(config.out or f"runs/compare_{config.env.name}_{config.preset}")
    run = parent_run(config, out) if config.run else ""  # `pretrained` is the task's own
    config = replace(config, episodes=config.episodes or DEFAULT_EPISODES, out=str(out), run=run)
    check_comparison(config)
    _open(out)
    config = compare_data.check_data(config, out)
    with comparison_lock(out):
        config = compare_data.prepare(config, out)
        plain = replace(config, compare=CompareConfig(evaluation_seed=config.compare.evaluation_seed))
        parents, records = compare_data.Parents(config, out), {}
        for job in jobs(config, out):
            own = job_config(plain, job, config.run, str(out / "lapo_world") if job.method == "lapo" else "")
            records[job] = job_record(job, own, parents.of(job))
        report = Comparison(config, out, records, began)
        report.references()
        _run_due(config, report)
        failed = report.write()
    print(report.table(), flush=True)
    print(f"compare: {time.monotonic() - began:.0f} s, {out / 'comparison.md'}", flush=True)
    if failed:
        names = ", ".join(row["name"] for row in failed)
        raise PlaySlotError(
            f"compare: {len(failed)} of {len(records)} jobs failed ({names}), the others finished; "
            f"{out / 'comparison.md'} says why, and the same command tries them again"
        )


def _run_due(config: ExperimentConfig, report: Comparison) -> None:
    """Write every job's file, and run those that are not done as they stand there.

    Raises:
        PlaySlotError: the launcher itself failed.
        KeyboardInterrupt: Ctrl-C. In both cases what there is has been written.
    """
    from playslot_rl.comparison.launch import read_status, run_process, run_sweep
    from playslot_rl.storage.atomic import write_json

    due = {}
    for job, record in report.jobs.items():
        write_json(job.file, record)
        status = read_status(job.file)
        if status.status == "done" and status.fingerprint == record["fingerprint"]:
            print(f"{job.name}: done before, skipped", flush=True)
        else:
            due[job.file] = job
    print(f"compare: {len(due)} of {len(report.jobs)} jobs to run", flush=True)
    try:
        if due and config.compare.launcher:
            # Those whose policy others take over come first; these would train it again, side by side.
            for first in (True, False):
                wave = [file for file, job in due.items() if (job.policy_of is None) is first]
                if wave:
                    run_sweep(wave, config.compare.launcher, config.compare.hydra)
        else:
            for file, job in due.items():
                run_process(file)
                report.ended(job)
    except KeyboardInterrupt:
        report.write()
        raise KeyboardInterrupt(f"compare interrupted; the same command carries on in {report.out}") from None
    except PlaySlotError:
        report.write()
        raise


def _open(out: Path) -> None:
    """Refuse a folder that holds something else.

    Raises:
        OutputError: it does.
    """
    from playslot_rl.comparison.launch import LOCK

    if out.exists() and not out.is_dir():
        raise OutputError(f"out={out}: got a file, expected a folder: choose another out=")
    names = {path.name for path in out.iterdir()} if out.is_dir() else set()
    if names and (not names & {LOCK, "jobs"} or names & {"meta", "config.json"}):
        raise OutputError(f"out={out}: got a folder that holds something else, expected none: choose another out=")
