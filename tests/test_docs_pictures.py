"""The pictures of docs/results.md's table are drawn from the numbers that stand in it."""

from __future__ import annotations

import io
import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from PIL import Image

TASKS = {"ButtonPress": 30, "easy BlockPush": 30}
"""Task and how many cells its rows have."""


@pytest.fixture(scope="module")
def pictures(repository: Path) -> ModuleType:
    spec = spec_from_file_location("pictures", repository / "docs" / "_site" / "pictures.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    return (repository / "docs" / "results.md").read_text()


def test_every_picture_of_the_table_is_looked_at(pictures: ModuleType, page: str) -> None:
    shown = set(re.findall(r"images/(labels_\w+\.png)", page))
    assert shown == set(pictures.PICTURES.values())
    assert set(pictures.PICTURES) == set(TASKS)


@pytest.mark.parametrize("task", TASKS)
def test_a_picture_is_as_new_as_its_rows(pictures: ModuleType, page: str, task: str) -> None:
    """After a number has changed: `.venv/bin/python docs/_site/pictures.py`."""
    found = pictures.numbers(page, task)
    assert len(found["cells"]) == TASKS[task]
    with Image.open(pictures.DOCS / "images" / pictures.PICTURES[task]) as stored:
        assert stored.text[pictures.FACT] == pictures.fingerprint(found)
        drawn = Image.open(io.BytesIO(pictures.draw(found)))
        difference = np.abs(np.asarray(stored.convert("RGB"), int) - np.asarray(drawn.convert("RGB"), int))
    assert difference.mean() < 1.0  # fonts may differ by a pixel's edge


def test_a_changed_number_makes_a_picture_old(pictures: ModuleType, page: str) -> None:
    before = pictures.numbers(page, "ButtonPress")
    assert before["cells"]["PlaySlot|150|2"] == [73, 63, 80, 49, 85]
    assert before["references"] == {"expert": 98, "random": 0}
    changed = pictures.numbers(page.replace("**73 %** (63 to 80", "**74 %** (63 to 80"), "ButtonPress")
    assert pictures.fingerprint(changed) != pictures.fingerprint(before)


def test_a_cell_of_another_form_is_named(pictures: ModuleType, page: str) -> None:
    with pytest.raises(ValueError, match=r"ButtonPress, PlaySlot: got '.*', expected MEAN %"):
        pictures.numbers(page.replace("**73 %** (63 to 80", "**73** (63 to 80"), "ButtonPress")
