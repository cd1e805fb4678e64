"""The scripts of docs/ that record sets to adopt: the sets are sound. They need a renderer and take a while."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from commands import smoke

pytestmark = pytest.mark.integration

DOCS = Path(__file__).resolve().parents[2] / "docs"
PAGES = (DOCS / "tutorials" / "your-own-videos.md", DOCS / "notebook" / "slots.md")
SCRIPTS = [
    script for page in PAGES for script in re.findall(r"^```py\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE)
]


def test_there_are_two() -> None:
    assert len(SCRIPTS) == 2


@pytest.mark.slow
@pytest.mark.parametrize("number", [0, 1])
def test_a_set_recorded_as_the_page_says_can_be_adopted(number: int, tmp_path: Path) -> None:
    script, changed = re.subn(r"for episode in range\(\d+\)", "for episode in range(3)", SCRIPTS[number])
    assert changed == 1
    subprocess.run([sys.executable, "-c", script], cwd=tmp_path, check=True, capture_output=True)
    (made,) = (tmp_path / "data").iterdir()
    run = tmp_path / "run"
    smoke("adopt", f"data.root={made}", f"out={run}", "minutes=0.02", "adopt.slots=[2]", "adopt.prototypes=4")
    assert (run / "dynamics" / "checkpoint" / "weights.safetensors").is_file()
