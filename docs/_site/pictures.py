"""Draws the pictures of the table "Videos instead of labels" in docs/results.md, from its own numbers:

    .venv/bin/python docs/_site/pictures.py

Each picture holds the fingerprint of the numbers that it was drawn from, and a test compares it with the page.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any, Final

from playslot_rl.config.methods import canonical_method
from playslot_rl.studies.page import comparison_figure
from playslot_rl.visualization.charts import LIGHT, figure_bytes

DOCS: Final = Path(__file__).resolve().parents[1]
PICTURES: Final = {"ButtonPress": "labels_button_press.png", "easy BlockPush": "labels_block_push_easy.png"}
"""Task, as the table calls it, and its picture in docs/images."""
FACT: Final = "Numbers"
"""Of a PNG's text: the fingerprint."""
CELL: Final = re.compile(r"(\d+) % \((\d+) to (\d+); seeds (\d+) to (\d+)\)")


def numbers(page: str, task: str) -> dict[str, Any]:
    """What the page says of a task: percentages by method, protocol and labels, and the two references.

    Raises:
        ValueError: the page has no such rows, or a cell of another form.
    """
    header = next(line for line in page.splitlines() if line.startswith("| task | videos | labelled demonstrations |"))
    titles = [cell.strip() for cell in header.strip("| ").split("|")][3:-1]
    cells = {}
    for line in page.splitlines():
        name, *values = (cell.strip(" *") for cell in line.strip("| ").split("|"))
        if name != task or len(values) != len(titles) + 3:
            continue
        for title, value in zip(titles, values[2:-1], strict=True):
            found = CELL.fullmatch(value.replace("*", ""))
            if found is None:
                raise ValueError(f"{task}, {title}: got {value!r}, expected MEAN % (LOW to HIGH; seeds A to B)")
            cells[f"{title}|{values[0].replace(',', '')}|{values[1]}"] = [int(number) for number in found.groups()]
    expert = re.search(rf"(\d+) % on {task}", page)
    if not cells or expert is None:
        raise ValueError(f"{task}: got no rows or no rate of the expert, expected both in docs/results.md")
    return {"cells": cells, "references": {"expert": int(expert[1]), "random": 0}}


def fingerprint(found: dict[str, Any]) -> str:
    """Of the numbers of a task."""
    return hashlib.sha256(repr(found).encode()).hexdigest()[:16]


def draw(found: dict[str, Any]) -> bytes:
    """The picture of a task's numbers, a PNG: small dots are the lowest and the highest seed."""
    summary, seeds = [], []
    for key, (mean, low, high, *ends) in found["cells"].items():
        title, videos, labels = key.split("|")
        name, dreamt = title.removesuffix(", in imagination"), title.endswith(", in imagination")
        row = {
            "method": canonical_method(name, acting=True),
            "title": name,
            "protocol": "imagination" if dreamt else "simulation",
            "demos": int(videos),
            "labels": int(labels),
        }
        summary.append(row | {"success_rate": mean / 100, "ci95": [low / 100, high / 100]})
        seeds += [row | {"success_rate": end / 100, "seed": seed, "curve": None} for seed, end in enumerate(ends)]
    references = {name: {"success_rate": rate / 100} for name, rate in found["references"].items()}
    result = {"summary": summary, "rows": seeds, "labels": True, "references": references}
    return figure_bytes(comparison_figure(result, LIGHT), LIGHT, facts={FACT: fingerprint(found)})


def main() -> None:
    """Draw all."""
    page = (DOCS / "results.md").read_text()
    for task, picture in PICTURES.items():
        (DOCS / "images" / picture).write_bytes(draw(numbers(page, task)))
        print(f"docs/images/{picture}")


if __name__ == "__main__":
    main()
