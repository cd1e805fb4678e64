"""The error of actions in place of success, where there is no simulator: rows pooled over world models and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from playslot_rl.evaluation.intervals import hierarchical
from playslot_rl.studies.success.summary import CELL, cells, finished, outcomes_of

ERRORS: Final = ("mae", "rmse", "r2", "references", "per_episode")
"""What a job's row has of its `eval_info.json`."""

TITLES: Final = {"constant": "(mean labelled action)", "previous": "(action of the step before)"}
"""Of what every policy is held against."""


def summarise_errors(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row a cell, as `summarise`: `mae`, `rmse` and `r2` are means over its runs, so are those of `references`, and
    `ci95` is the interval of `mae`."""
    return [_summary(cell, runs) for cell, runs in cells(finished(rows)).items()]


def _summary(cell: tuple[Any, ...], runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    names, seeds = list(runs[0]["references"]), sorted({run["seed"] for run in runs})
    return {
        **dict(zip(CELL, cell, strict=True)),
        "title": runs[0]["title"],
        **{key: runs[0][key] for key in ("agent_steps", "env_steps", "labelled_demos")},
        "worlds": sorted({run["world"] for run in runs}),
        "seeds": seeds,
        "runs": len(runs),
        "episodes": runs[0]["episodes"],
        **_means(runs),
        "ci95": list(hierarchical(outcomes_of(runs, seeds), (0.0, np.inf), runs[0]["per_episode"]["rows"])),
        "references": {name: _means([run["references"][name] for run in runs]) for name in names},
        "train_seconds": sum(run["train_seconds"] for run in runs) / len(runs),
    }


def _means(rows: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    known = {key: [row[key] for row in rows if row[key] is not None] for key in ("mae", "rmse", "r2")}
    return {key: float(np.mean(values)) if values else None for key, values in known.items()}


def error_references(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of a table for what every policy is held against: at each number of labels the same for all methods."""
    known = sorted((row for row in rows if "mae" in row and row["at"] is not None), key=lambda row: row["runs"])
    at = {row["at"]: row for row in known}  # of most runs, for their labels are drawn anew
    return [
        {"title": title, "protocol": "actions", "at": number, **row["references"][name]}
        for name, title in TITLES.items()
        for number, row in at.items()
    ]
