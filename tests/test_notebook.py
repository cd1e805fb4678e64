"""examples/quickstart.ipynb runs, and shows what is stored in it."""

from __future__ import annotations

import json
from collections.abc import Callable
from types import ModuleType
from typing import Any

import pytest
from PIL import Image


@pytest.fixture(scope="module")
def runner(site_module: Callable[[str], ModuleType]) -> ModuleType:
    return site_module("notebook")


@pytest.fixture(scope="module")
def notebook(runner: ModuleType) -> dict[str, Any]:
    read: dict[str, Any] = json.loads(runner.NOTEBOOK.read_text())
    return read


def kinds(outputs: list[dict[str, Any]]) -> list[str]:
    """Of each output: text that was printed, a picture, or a value."""
    return [
        "text" if output["output_type"] == "stream" else "picture" if "image/png" in output["data"] else "value"
        for output in outputs
    ]


def test_the_notebook_is_small_and_its_cells_have_run_in_order(notebook: dict[str, Any], runner: ModuleType) -> None:
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    assert runner.NOTEBOOK.stat().st_size < 10**6
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert sum(kinds(cell["outputs"]).count("picture") for cell in cells) >= 5


def test_what_a_cell_shows_is_stored_as_text_picture_or_value(runner: ModuleType) -> None:
    assert runner.outputs("", None, 1) == []
    shown = runner.outputs("two\nlines\n", Image.new("RGB", (2, 2)), 3)
    assert kinds(shown) == ["text", "picture"]
    assert kinds(runner.outputs("", (1, 2), 1)) == ["value"]


@pytest.mark.integration
def test_the_notebook_runs_and_shows_what_is_stored(notebook: dict[str, Any], runner: ModuleType) -> None:
    """After a change: `make notebook`. Numbers and pixels differ between processors, so only kinds are compared."""
    stored = [kinds(cell["outputs"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    shown = [kinds(runner.outputs(printed, value, 1)) for printed, value in runner.run(notebook)]
    assert shown == stored
