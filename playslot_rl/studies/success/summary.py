"""Rows of finished jobs pooled over world models and policy seeds: rates, differences to a reference, over tasks.

Without a simulator the outcome of an episode is the mean error of its actions, and their number its weight, so that
the mean is that of actions.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from playslot_rl.config.methods import METHODS
from playslot_rl.evaluation.intervals import (
    Outcomes,
    apart_over_tasks,
    hierarchical,
    of_differences,
    of_successes,
    over_tasks,
    paired,
    weighted_mean,
)

Row = Mapping[str, Any]
CELL = ("method", "protocol", "demos", "labels")
"""What names a cell of the table."""


def cells(rows: Iterable[Row]) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by cell: one for each world model and seed."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in CELL), []).append(row)
    return found


def finished(rows: Iterable[Row]) -> list[Row]:
    return [row for row in rows if row["success_rate"] is not None or "mae" in row]


def outcomes_of(runs: Sequence[Row], seeds: Sequence[int]) -> Outcomes:
    """Outcomes (W, S, E) of a cell's runs, 1 for a success, or errors; NaN where a seed has no run."""
    worlds = sorted({run["world"] for run in runs})
    found = np.full((len(worlds), len(seeds), runs[0]["episodes"]), np.nan)
    for run in runs:
        if run["seed"] in seeds:
            found[worlds.index(run["world"]), seeds.index(run["seed"])] = _of_episodes(run)
    return found


def _of_episodes(run: Row) -> Sequence[float]:
    errors: Sequence[float] = run["per_episode"]["mae"] if "mae" in run else [int(one) for one in run["outcomes"]]
    return errors


def summarise(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """One row a cell: steps, seconds and `success_rate` are means over its runs, `lowest` and `highest` rates of one.

    `ci95` is over world models, policy seeds and episodes (`playslot_rl.evaluation.intervals`).
    """
    return [_summary(cell, runs) for cell, runs in cells(finished(rows)).items()]


def _summary(cell: tuple[Any, ...], runs: Sequence[Row]) -> dict[str, Any]:
    rates, seeds = [run["success_rate"] for run in runs], sorted({run["seed"] for run in runs})
    return {
        **dict(zip(CELL, cell, strict=True)),
        "title": runs[0]["title"],
        **{key: _mean(run[key] for run in runs) for key in ("agent_steps", "env_steps", "train_seconds")},
        "worlds": sorted({run["world"] for run in runs}),
        "seeds": seeds,
        "runs": len(runs),
        "success_rate": sum(rates) / len(rates),
        "ci95": list(of_successes(outcomes_of(runs, seeds))),
        "lowest": min(rates),
        "highest": max(rates),
        "episodes": sum(run["episodes"] for run in runs),
        "labelled_demos": runs[0]["labelled_demos"],
    }


def _mean(values: Iterable[float | None]) -> int | None:
    known = [value for value in values if value is not None]
    return round(sum(known) / len(known)) if known else None


def differences(rows: Sequence[Row], reference: str) -> list[dict[str, Any]]:
    """Success in simulation of each cell, or its error of actions, less that of the reference method, on pairs of the
    same world model, seed and episode; `demos` and `labels` are those of the pair, `leaves_out_0` says that the
    interval does, and `better` whether the cell then is, None where it does not: of errors the lower is better. A
    method of one world model, finished or not, meets all of the other's.

    What learns from the labels alone meets the reference at every number of videos, an oracle at every number of
    labels, and a method that acts at all of them.
    """
    found, known, worlds = [], cells(finished(rows)), dict[str, set[int]]()
    for row in rows:  # those that are to come, too
        worlds.setdefault(row["method"], set()).add(row["world"])
    for other, there in known.items():
        if other[0] != reference or other[1] not in ("simulation", "actions"):
            continue
        for cell, runs in known.items():
            if cell[:2] == other[:2] or not (at := _pair(cell, other)):
                continue
            met = _met(runs, there, min(len(worlds[cell[0]]), len(worlds[reference])) > 1)
            if met is None:
                continue
            seeds, tables = met
            of_errors = "mae" in there[0]
            apart, actions = paired(*tables), there[0]["per_episode"]["rows"] if of_errors else 1.0
            low, high = hierarchical(apart, weights=actions) if of_errors else of_differences(*tables)
            clear = low > 0 or high < 0
            found.append(
                {
                    **dict(zip(CELL, (*cell[:2], *at), strict=True)),
                    "title": runs[0]["title"],
                    "seeds": seeds,
                    "difference": weighted_mean(apart, actions),
                    "ci95": [low, high],
                    "leaves_out_0": clear,
                    "better": (high < 0) == of_errors if clear else None,
                }
            )
    return found


def _pair(cell: tuple[Any, ...], reference: tuple[Any, ...]) -> tuple[Any, Any] | None:
    """Demonstrations and labels at which two cells meet; None where they do not."""
    demos, labels = (sorted({side[at] for side in (cell, reference)} - {None}) for at in (2, 3))
    alone = [METHODS[side[0]].labelled_only for side in (cell, reference)]
    if len(labels) > 1 or (len(demos) > 1 and not any(alone)):
        return None
    return (cell if alone[1] else reference)[2], labels[0] if labels else None


def _met(
    runs: Sequence[Row], reference: Sequence[Row], several: bool
) -> tuple[list[int], tuple[Outcomes, Outcomes]] | None:
    """The seeds that both sides have, and the outcomes of each, paired by world models where both have `several`; None
    where they have no seed in common."""
    sides = _in_both(runs, reference, ("world", "seed") if several else ("seed",))
    seeds = sorted({run["seed"] for run in sides[0]})
    return (seeds, (outcomes_of(sides[0], seeds), outcomes_of(sides[1], seeds))) if seeds else None


def _in_both(runs: Sequence[Row], reference: Sequence[Row], keys: Sequence[str]) -> tuple[list[Row], list[Row]]:
    """The runs of two cells that have one like them in the other."""
    first, second = ({tuple(run[key] for key in keys) for run in side} for side in (runs, reference))
    pairs = first & second
    mine, theirs = ([run for run in side if tuple(run[key] for key in keys) in pairs] for side in (runs, reference))
    return mine, theirs


def across_tasks(results: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Interquartile means over the runs of all tasks, `score` and `ci95`, of methods and labels of which each task has
    every run. Where a task has several numbers of demonstrations, the largest counts.
    """
    tasks = [largest(result["rows"]) for result in results]
    rows = []
    for key in tasks[0] if tasks else ():
        runs = [task.get(key, []) for task in tasks]
        if not all(map(_all_done, runs)):
            continue
        outcomes = [outcomes_of(side, sorted({run["seed"] for run in side})) for side in runs]
        if any(np.isnan(one).any() for one in outcomes):
            continue
        score, interval = over_tasks(outcomes)
        values = dict(zip(("method", "protocol", "labels"), key, strict=True))
        rows.append(values | {"title": runs[0][0]["title"], "score": score, "ci95": list(interval)})
    return rows


def apart_across_tasks(results: Sequence[Mapping[str, Any]], reference: str | None) -> list[dict[str, Any]]:
    """Success in simulation less that of the reference method, `difference` and `ci95`, the mean over tasks, of methods
    that have all runs of all tasks, and as many labels."""
    tasks, found = [largest(result["rows"]) for result in results], list[dict[str, Any]]()
    whole = [key for key in (tasks[0] if tasks else ()) if all(_all_done(task.get(key)) for task in tasks)]
    whole = [key for key in whole if key[1] == "simulation"]
    for first in (key for key in whole if key[0] == reference):
        for key in whole:
            if key == first or key[2] != first[2]:
                continue
            sides = []
            for task in tasks:
                several = min(len({run["world"] for run in task[side]}) for side in (key, first)) > 1
                sides += [met[1]] if (met := _met(task[key], task[first], several)) else []
            if len(sides) == len(tasks):
                value, interval = apart_over_tasks(sides)
                names = dict(zip(("method", "protocol", "labels"), key, strict=True))
                found.append({**names, "title": tasks[0][key][0]["title"], "difference": value, "ci95": list(interval)})
    return found


def _all_done(runs: Sequence[Row] | None) -> bool:
    return bool(runs) and len(finished(runs or ())) == len(runs or ())


def largest(rows: Sequence[Row]) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by method, protocol and labels, of the largest number of demonstrations, finished or not."""
    known, most = cells(rows), dict[tuple[Any, ...], tuple[Any, ...]]()
    for cell in known:
        key = (*cell[:2], cell[3])
        if key not in most or (cell[2] or 0) > (most[key][2] or 0):
            most[key] = cell
    return {key: known[cell] for key, cell in most.items()}
