"""One job of a comparison: `python -m playslot_rl.recipes.compare_job OUT/jobs/NAME.json`.

Trains and evaluates what the file says; what is done is skipped, so running it again carries on. Exit code 0 done, 1
failed (the status file beside it has the error), 130 interrupted.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.errors import explain
from playslot_rl.runtime.devices import processor
from playslot_rl.storage.checkpoints import source_commit
from playslot_rl.studies.launch import Status, job_lock, read_status, write_status

if TYPE_CHECKING:
    from playslot_rl.studies.success.measure import SuccessMeasure
    from playslot_rl.studies.video.measure import VideoMeasure


def main(file: Path) -> Status:
    """Run the job of a file, after any other process that works on it. How it ended is `done`, or `failed` with one
    line: a crash of a method is a row of the table, so every error ends here.
    """
    job = json.loads(file.read_text())
    with job_lock(file):
        known = read_status(file, job["fingerprint"])
        if known.status == "done" and _measure(job).agrees(job):
            return known
        began = time.monotonic()
        write_status(file, Status("running", job["fingerprint"]))
        try:
            from playslot_rl.recipes import evaluate

            _measure(job).run(job, evaluate.once)
        except Exception as error:  # noqa: BLE001  whatever a method dies of is its row's business
            failed = Status("failed", job["fingerprint"], explain(error), round(time.monotonic() - began, 1))
            write_status(file, failed)
            print(f"{job['name']}: error: {failed.error}", file=sys.stderr, flush=True)
            return failed
        spent = round(time.monotonic() - began, 1)
        done = Status("done", job["fingerprint"], "", spent, source_commit(), processor())
        write_status(file, done)
        return done


def _measure(job: dict[str, Any]) -> type[SuccessMeasure | VideoMeasure]:
    if job.get("kind") == "video":
        from playslot_rl.studies.video.measure import VideoMeasure

        return VideoMeasure
    from playslot_rl.studies.success.measure import SuccessMeasure

    return SuccessMeasure


if __name__ == "__main__":
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
    from playslot_rl.envs.rendering import import_mujoco

    import_mujoco()  # torchrl imports it too, and would fail without our cure
    try:
        sys.exit(0 if main(Path(sys.argv[1])).status == "done" else 1)
    except KeyboardInterrupt:
        sys.exit(130)
