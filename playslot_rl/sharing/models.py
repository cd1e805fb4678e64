"""The models that ship: what they are, how they were made, and how good they are.

What is measured lies beside them, in `pretrained/shipped_models.json` and `report_cards.json`, tables as those of
results/; a column with `meta` is read from the checkpoints' own files, `STAGE/KEY/...`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any, Final

from playslot_rl.evaluation.intervals import wilson
from playslot_rl.runs import Run, pretrained_folder

LICENCE: Final = "Apache-2.0"
EPISODES: Final = 100
"""In each block in which success was measured."""
PROTOCOLS: Final = ("simulation", "imagination", "replay")


def shipped_table() -> dict[str, Any]:
    """The table of shipped models, one a row, as results/README.md says, with what their own files know."""
    table: dict[str, Any] = _tables("shipped_models.json")["shipped_models"]
    names = [column["key"] for column in table["columns"]]
    for row in table["rows"]:
        run = Run.open(f"pretrained/{row[names.index('name')]}")
        for place, column in enumerate(table["columns"]):
            if "meta" in column:
                found = [_known(run, path, column) for path in column["meta"]]
                row[place] = found[0] if len(found) == 1 else ", ".join(found) if "characters" in column else found
            elif column["key"] in PROTOCOLS:
                row[place] = {"value": row[place], "interval": _interval(row[place])}
    return table


@dataclass(frozen=True)
class Models:
    """What `playslot models` shows: of each model the values by name."""

    rows: list[dict[str, Any]]

    def lines(self) -> list[str]:
        lines: list[str] = []
        for row in self.rows:
            width = max(map(len, row))
            lines += [f"{row['name']}:", *(f"  {key:<{width}}  {_text(value)}" for key, value in row.items()), ""]
        return [*lines, "playslot_rl.load('pretrained/NAME') and run=pretrained/NAME load one of them"]

    def to_json(self) -> str:
        return json.dumps(self.rows, indent=2)


def shipped_models(name: str = "") -> Models:
    """All shipped models, or the one of that name; a CheckpointError, with the nearest name, where there is none.

    Examples:
        >>> [row["task"] for row in shipped_models("block_push").rows]
        ['BlockPush, four cubes']
    """
    if name:
        pretrained_folder(name)
    table, cards = shipped_table(), _tables("report_cards.json")["report_cards"]
    names, titles = [column["key"] for column in table["columns"]], [column["title"] for column in cards["columns"]]
    rows = []
    for values in table["rows"]:
        row = dict(zip(names, values, strict=True))
        folder = pretrained_folder(row["name"])
        own = [line[titles.index(row["task"].partition(",")[0])] for line in cards["rows"]]
        said = Counter(value["note"] for value in own if value)
        row |= {
            "report_card": {word: said[word] for word in ("good", "fair", "BAD")},
            "licence": LICENCE,
            "megabytes": round(sum(path.stat().st_size for path in folder.rglob("*.safetensors")) / 1e6, 1),
        }
        rows.append(row)
    return Models([row for row in rows if name in ("", row["name"])])


def _tables(name: str) -> dict[str, Any]:
    tables: dict[str, Any] = json.loads((pretrained_folder().parent / name).read_text())["tables"]
    return tables


def _known(run: Run, path: str, column: Mapping[str, Any]) -> Any:
    """A value of a checkpoint's meta file, or, after `config`, of its config."""
    stage, *keys = path.split("/")
    checkpoint = run.own(stage)
    value: Any = reduce(lambda group, key: group[key], keys, {**checkpoint.meta, "config": checkpoint.config})
    if isinstance(value, float):
        digits = column.get("digits", 0)
        return float(f"{value:.{digits}g}") if digits else round(value)
    return value[: column.get("characters")] if isinstance(value, str) else value


def _interval(percents: list[int]) -> list[int]:
    """Of the blocks together, %."""
    won, played = sum(percents) * EPISODES / 100, EPISODES * len(percents)
    return [round(100 * end) for end in wilson(won, played)]


def _text(value: Any) -> str:
    if isinstance(value, Mapping) and "interval" in value:
        return f"{_text(value['value'])} % ({' to '.join(map(str, value['interval']))} of both)"
    if isinstance(value, Mapping):
        return ", ".join(f"{count} {word}" for word, count in value.items())
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
