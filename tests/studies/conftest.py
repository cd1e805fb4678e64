"""The folder's helper modules, and a comparison that has ended."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from jobs_on_disk import comparison, finish

from playslot_rl.storage.atomic import write_json
from playslot_rl.studies.launch import Status, read_status, write_status
from playslot_rl.studies.success.jobs import SuccessJob
from playslot_rl.studies.success.measure import job_rows


@pytest.fixture
def ended(tmp_path: Path) -> dict[str, Any]:
    """Two seeds of PlaySlot and the oracle, one failed LAPO, one online method with a curve."""
    jobs = [
        finish(SuccessJob("playslot", 10, 0, tmp_path), {"simulation": 8, "imagination": 3}, labelled_demos=5),
        finish(SuccessJob("playslot", 10, 1, tmp_path), {"simulation": 6, "imagination": 1}, labelled_demos=5),
        finish(SuccessJob("slot_oracle", 10, 0, tmp_path), {"simulation": 10}, steps=100),
        finish(SuccessJob("slot_oracle", 50, 0, tmp_path), {"simulation": 10}),
        finish(SuccessJob("resnet_oracle", 10, 0, tmp_path), {"simulation": 4}, pretraining="scratch", kept_rows=0.5),
        finish(SuccessJob("dreamer", None, 0, tmp_path), {"simulation": 7}, env_steps=2000),
    ]
    points = [{"env_steps": n, "success_rate": n / 4000, "ci95": [0, 1]} for n in (0, 1000, 2000)]
    write_json(jobs[-1].run / "dreamer" / "curve.json", {"rows": points})
    write_json(jobs[2].run / "slot_oracle" / "checkpoint" / "config.json", {"slot_oracle": {"batch_size": 16}})
    failed = SuccessJob("lapo", 10, 0, tmp_path)
    write_status(failed.file, Status("failed", "f", "loss is nan at step 3, expected a finite number", 1.0))
    rows = [row for job in [*jobs, failed] for row in job_rows(job, 5, read_status(job.file))]
    return comparison(tmp_path, rows)
