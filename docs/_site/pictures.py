"""Draws success over labels from the table `videos_and_labels` in results/:

    make tables

Each picture holds the fingerprint of the numbers that it was drawn from, and a test compares it with the table.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Final

from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from playslot_rl.config.methods import canonical_method
from playslot_rl.studies.success.figure import success_figure
from playslot_rl.visualization.charts import LIGHT, figure_bytes

ROOT: Final = Path(__file__).resolve().parents[2]
IMAGES: Final = ROOT / "docs" / "images"
PICTURES: Final = {"ButtonPress": "labels_button_press.png", "easy BlockPush": "labels_block_push_easy.png"}
"""Task, as the table calls it, and its picture in docs/images."""
FACT: Final = "Numbers"
"""Of a PNG's text: the fingerprint."""


def tables() -> dict[str, Any]:
    """Those of results/videos_and_labels.json."""
    read: dict[str, Any] = json.loads((ROOT / "results" / "videos_and_labels.json").read_text())["tables"]
    return read


def numbers(tables: dict[str, Any], task: str) -> dict[str, Any]:
    """Percentages of a task by method, protocol, videos and labels, and its two references."""
    table = tables["videos_and_labels"]
    cells = {}
    for name, videos, labels, *values in table["rows"]:
        if name != task:
            continue
        for column, cell in zip(table["columns"][3:], values, strict=True):
            if column.get("unit") == "%":
                key = f"{column['title']}|{videos}|{labels}"
                cells[key] = [cell["value"], *cell["interval"], *cell["seeds"]]
    if not cells:
        raise ValueError(f"videos_and_labels: got no rows of {task!r}")
    expert, random = next(row[1:3] for row in tables["videos_and_labels_references"]["rows"] if row[0] == task)
    return {"cells": cells, "references": {"expert": expert, "random": random}}


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
            "world": 0,
        }
        summary.append(row | {"success_rate": mean / 100, "ci95": [low / 100, high / 100]})
        seeds += [row | {"success_rate": end / 100, "seed": seed, "curve": None} for seed, end in enumerate(ends)]
    references = {name: {"success_rate": rate / 100} for name, rate in found["references"].items()}
    result = {"summary": summary, "rows": seeds, "labels": True, "videos": [], "differences": []}
    result["references"] = references
    return figure_bytes(success_figure(result, LIGHT), LIGHT, facts={FACT: fingerprint(found)})


def stale(path: Path, found: dict[str, Any]) -> bool:
    """Whether the picture is missing or of other numbers."""
    if not path.is_file():
        return True
    with Image.open(path) as stored:
        return not isinstance(stored, PngImageFile) or stored.text.get(FACT) != fingerprint(found)


def main() -> None:
    """Draw the pictures whose numbers have changed."""
    read = tables()
    for task, picture in PICTURES.items():
        found = numbers(read, task)
        if stale(IMAGES / picture, found):
            (IMAGES / picture).write_bytes(draw(found))
            print(f"docs/images/{picture}")


if __name__ == "__main__":
    main()
