"""The tables and plots of README.md and docs/ are those that results/*.json make; a changed number is noticed."""

from __future__ import annotations

import io
import json
import re
import shlex
from collections.abc import Callable
from copy import deepcopy
from decimal import Decimal
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from playslot_rl.speed import gpu

TASKS = {"ButtonPress": 30, "easy BlockPush": 30}
"""Tasks that have a picture, and how many numbers it shows."""
PROGRAMS = {"playslot", "make", "python", ".venv/bin/python"}


@pytest.fixture(scope="module")
def tables(site_module: Callable[[str], ModuleType]) -> ModuleType:
    return site_module("tables")


@pytest.fixture(scope="module")
def pictures(site_module: Callable[[str], ModuleType]) -> ModuleType:
    return site_module("pictures")


@pytest.fixture(scope="module")
def read(tables: ModuleType) -> dict[str, Any]:
    read: dict[str, Any] = tables.load_tables(tables.ROOT / "results")
    return read


def test_every_page_holds_what_the_numbers_make(tables: ModuleType, read: dict[str, Any]) -> None:
    """After a change in results/: `make tables`."""
    old = [page.name for page in tables.pages() if tables.written(page.read_text(), read) != page.read_text()]
    assert old == []


def test_every_table_is_on_a_page(tables: ModuleType, read: dict[str, Any]) -> None:
    pages = "".join(page.read_text() for page in tables.pages())
    shown = {name.split("/")[0] for name in re.findall(r"<!-- results:([\w/]+) -->", pages)}
    assert shown == set(read)
    assert len(tables.MARKED.findall(pages)) == pages.count("<!-- results:") == pages.count("<!-- /results -->")


def test_a_changed_number_makes_a_page_old(tables: ModuleType, read: dict[str, Any]) -> None:
    page = "before\n<!-- results:videos_and_labels/readme -->\n\n<!-- /results -->\nafter"
    written = tables.written(page, read)
    assert "| ButtonPress | 150 | 5 | **95 %** | 84 % | 91 % | 86 % |" in written
    assert written.startswith("before\n")
    assert written.endswith("\nafter")
    assert tables.written(written, read) == written
    assert tables.written(written.replace("84 %", "85 %"), read) == written


@pytest.mark.parametrize(
    ("value", "column", "text"),
    [
        (None, {}, ""),
        ("as it is", {"unit": "%"}, "as it is"),
        (Decimal("0.330"), {}, "0.330"),
        (Decimal(4800), {}, "4,800"),
        (Decimal(73), {"unit": "%"}, "73 %"),
        ([Decimal(97), Decimal(98)], {"unit": "%"}, "97, 98 %"),
        ([Decimal("31.03"), Decimal("0.955")], {"join": " / "}, "31.03 / 0.955"),
        ({"value": Decimal("0.58"), "note": "good"}, {}, "0.58 good"),
        (
            {"value": 73, "interval": [63, 80], "seeds": [49, 85], "best": True},
            {"unit": "%"},
            "**73 %** (63 to 80; seeds 49 to 85)",
        ),
    ],
)
def test_a_cell_is_written_as_the_pages_have_it(
    tables: ModuleType, value: Any, column: dict[str, Any], text: str
) -> None:
    assert tables.cell(value, column) == text


def test_a_row_of_another_width_is_named(tables: ModuleType, tmp_path: Path) -> None:
    table = {"columns": [{"title": "task"}], "rows": [["ButtonPress", 1]], "made": []}
    (tmp_path / "wide.json").write_text(json.dumps({"question": "?", "tables": {"wide": table}}))
    with pytest.raises(ValueError, match="wide: got 2 cells"):
        tables.load_tables(tmp_path)


def test_every_lot_of_rows_says_how_it_was_made(read: dict[str, Any]) -> None:
    keys = {"rows", "command", "commit", "machine", "time", "date"}
    for name, table in read.items():
        assert table["made"], name
        assert all(set(lot) == keys for lot in table["made"]), name
        for lot in table["made"]:
            assert lot["date"] is None or re.fullmatch(r"2026-\d\d-\d\d", lot["date"])
            assert lot["commit"] is None or re.search(r"\b[0-9a-f]{7}\b", lot["commit"])


def test_commands_are_whole_lines_of_a_shell(read: dict[str, Any]) -> None:
    for name, table in read.items():
        for lot in table["made"]:
            text = "\n".join(lot["command"] or []).replace("\\\n", " ")
            assert all(shlex.split(line)[0] in PROGRAMS for line in text.splitlines()), (name, text)


def test_every_picture_of_the_numbers_is_looked_at(pictures: ModuleType, tables: ModuleType) -> None:
    pages = "".join(page.read_text() for page in tables.pages())
    assert set(re.findall(r"images/(labels_\w+\.png)", pages)) == set(pictures.PICTURES.values())
    assert set(pictures.PICTURES) == set(TASKS)


@pytest.mark.integration
@pytest.mark.parametrize("task", TASKS)
def test_a_picture_is_as_new_as_its_rows(pictures: ModuleType, task: str) -> None:
    """After a number has changed: `make tables`."""
    found = pictures.numbers(pictures.tables(), task)
    assert len(found["cells"]) == TASKS[task]
    path = pictures.IMAGES / pictures.PICTURES[task]
    assert not pictures.stale(path, found)
    with Image.open(path) as stored:
        drawn = Image.open(io.BytesIO(pictures.draw(found)))
        difference = np.abs(np.asarray(stored.convert("RGB"), int) - np.asarray(drawn.convert("RGB"), int))
    assert difference.mean() < 1.0  # fonts may differ by a pixel's edge


def test_a_changed_number_makes_a_picture_old(pictures: ModuleType, tmp_path: Path) -> None:
    before = pictures.tables()
    found = pictures.numbers(before, "ButtonPress")
    assert found["cells"]["PlaySlot|150|2"] == [73, 63, 80, 49, 85]
    assert found["references"] == {"expert": 98, "random": 0}
    after = deepcopy(before)
    after["videos_and_labels"]["rows"][0][3]["value"] = 74
    path = pictures.IMAGES / pictures.PICTURES["ButtonPress"]
    assert pictures.stale(path, pictures.numbers(after, "ButtonPress"))
    assert pictures.stale(tmp_path / "missing.png", found)


def test_a_task_without_rows_is_named(pictures: ModuleType) -> None:
    with pytest.raises(ValueError, match="got no rows of 'Maze'"):
        pictures.numbers(pictures.tables(), "Maze")


def test_a_gpus_bench_fills_its_table(tables: ModuleType, site_module: Callable[[str], ModuleType]) -> None:
    rows, empty = site_module("bench_rows"), gpu.empty()
    empty["savi_step"] |= {"paper_bf16_eager": 0.2, "paper_bf16_captured": 0.1}
    empty["savi_step_batch"]["paper"], empty["savi_step_arithmetic"]["paper"] = 64, 20.0
    machine = {"gpu": "NVIDIA H200", "peak_tflops": 800.4, "torch": "2.11.0", "cores": 16, "cpu": "Xeon"}
    before = json.loads(rows.FILE.read_text())
    after = rows.filled(deepcopy(before), {**empty, "machine": machine}, "0123abc")
    assert json.loads(rows.written(after)) == after
    table = after["tables"].pop("gpu_bench")
    assert len(table["rows"][0]) == len(table["columns"])
    shown = tables.markdown(table)
    assert "| `savi_step` | paper | bf16 | 64 | 200.0 | 100.0 | 2.0 | | | 25.0 |" in shown
    assert "commit 0123abc" in tables.made(table)
    assert "one NVIDIA H200, 800 TFLOP/s in a large product, torch 2.11.0, 16 cores (Xeon)" in tables.made(table)
    assert after["tables"] == {name: entry for name, entry in before["tables"].items() if name != "gpu_bench"}
