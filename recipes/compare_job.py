"""One job of a comparison: `python -m playslot_rl.recipes.compare_job OUT/jobs/NAME.json`.

Trains and evaluates what the file says; what is done is skipped, so running it again carries on. Exit code 0 done, 1
failed (the status file beside it has the error), 130 interrupted.
"""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from playslot_rl.config import ExperimentConfig, from_dict
from playslot_rl.errors import explain
from playslot_rl.studies.launch import Status, job_lock, read_status, write_status


def main(file: Path) -> Status:
    """Run the job of a file, after any other process that works on it.

    Returns:
        How it ended: `done`, or `failed` with one line of error. A crash of a method is a row of the table, so every
        error ends here.
    """
    job = json.loads(file.read_text())
    with job_lock(file):
        known = read_status(file)
        if known.status == "done" and known.fingerprint == job["fingerprint"]:
            return known
        began = time.monotonic()
        write_status(file, Status("running", job["fingerprint"]))
        try:
            _run(job)
        except Exception as error:  # noqa: BLE001  whatever a method dies of is its row's business
            failed = Status("failed", job["fingerprint"], explain(error), round(time.monotonic() - began, 1))
            write_status(file, failed)
            print(f"{job['name']}: error: {failed.error}", file=sys.stderr, flush=True)
            return failed
        done = Status("done", job["fingerprint"], "", round(time.monotonic() - began, 1))
        write_status(file, done)
        return done


def _run(job: dict[str, Any]) -> None:
    if job.get("kind") == "video":
        from playslot_rl.recipes import compare_video_job

        compare_video_job.run(job)
        return
    from playslot_rl.evaluation.success import DEFAULT_EPISODES, run_facts, task_facts
    from playslot_rl.recipes import evaluate, train_baseline
    from playslot_rl.runs import Run
    from playslot_rl.studies.several import train_on_several

    config, processes = from_dict(ExperimentConfig, job["config"]), int(job["processes"])
    if processes > 1:
        train_on_several("train-baseline", config, processes)
    else:
        train_baseline.main(config)
    run, seed = Path(config.out), int(job["evaluation_seed"])
    facts = {
        "episodes": config.episodes or DEFAULT_EPISODES,
        "seed": seed,
        "fingerprints": run_facts(run, job["method"]).fingerprints,
        **task_facts(config, seed),
    }
    for protocol in job["protocols"]:
        if not evaluate.measured(Run(run), protocol, facts):
            again = replace(config, run=config.out, out="", seed=seed, protocol=protocol)
            evaluate.main(again, report=False)


if __name__ == "__main__":
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    from playslot_rl.envs.rendering import import_mujoco

    import_mujoco()  # torchrl imports it too, and would fail without our cure
    try:
        sys.exit(0 if main(Path(sys.argv[1])).status == "done" else 1)
    except KeyboardInterrupt:
        sys.exit(130)
