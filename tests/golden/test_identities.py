"""Old runs, half-finished trainings and finished comparisons are recognised: what identifies them is what it was.

`PLAYSLOT_RENEW_GOLDEN=1 pytest tests/golden` writes the files again. Do so only where an identity changes on purpose:
runs from before are other runs then.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
from jobs import job_identities
from stages import stage_identities

pytestmark = [pytest.mark.integration, pytest.mark.usefixtures("thin_resnets")]


def _compare(name: str, values: dict[str, Any]) -> None:
    path = Path(__file__).parent / name
    text = json.dumps(values, indent=1, sort_keys=True) + "\n"
    if os.environ.get("PLAYSLOT_RENEW_GOLDEN") == "1":
        path.write_text(text)
    assert json.loads(text) == json.loads(path.read_text())
    assert text == path.read_text()


def test_every_stage_is_identified_by_what_it_was_identified_by(tmp_path: Path) -> None:
    _compare("stages.json", stage_identities(tmp_path))


def test_every_job_of_a_comparison_is_the_job_it_was() -> None:
    _compare("jobs.json", job_identities())
