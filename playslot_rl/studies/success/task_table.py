"""Success over tasks: what several comparisons say together, as values, and as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from playslot_rl.config.methods import METHODS
from playslot_rl.evaluation.intervals import points_text, rate_text
from playslot_rl.studies.study import FOOTNOTES, Result, machine_note
from playslot_rl.studies.success.summary import CELL, across_tasks, apart_across_tasks, largest
from playslot_rl.visualization.document import Block, Document, Linked, Notes, Section, Table, Text

IQM = "interquartile mean"


def joint_table(results: Sequence[Result], reference: str | None) -> dict[str, Any]:
    """`tasks`; `summary`, every task's with its `env`; `cells`, of these the ones of the largest number of
    demonstrations, with `runs` that are done, `of` all; `rows`, the interquartile means over tasks; `differences`, the
    means over tasks of those to the reference; and `ahead`, of each number of labels the tasks in which the reference
    in simulation beats every method on these labels alone, those in which it does by intervals of the paired
    differences (`surely`), and those in which it does not, of tasks that have all runs.
    """
    cells = [cell for result in results for cell in _cells(result)]
    return {
        "tasks": [result["env"] for result in results],
        "rows": across_tasks(results),
        "summary": [{"env": result["env"], **row} for result in results for row in result["summary"]],
        "cells": cells,
        "reference": reference,
        "differences": apart_across_tasks(results, reference),
        "ahead": _ahead(results, cells, reference),
    }


def _cells(result: Result) -> list[dict[str, Any]]:
    known, found = {tuple(row[name] for name in CELL): row for row in result["summary"]}, []
    for runs in largest(result["rows"]).values():
        own = {name: runs[0][name] for name in CELL}
        measured = known.get(tuple(own.values()), {})
        counts = {
            "worlds": len({run["world"] for run in runs}),
            "runs": sum(run["status"] == "done" for run in runs),
            "of": len(runs),
        }
        rates = {name: measured.get(name) for name in ("success_rate", "ci95")}
        found.append({"env": result["env"], **own, **counts, **rates})
    return found


def _ahead(results: Sequence[Result], cells: Sequence[Result], reference: str | None) -> list[dict[str, Any]]:
    found = []
    for labels in sorted({cell["labels"] for cell in cells} - {None}):
        sides: dict[str, Any] = {"labels": labels, "ahead": [], "surely": [], "behind": []}
        for result in results:
            task = result["env"]
            own = [cell for cell in cells if (cell["env"], cell["labels"]) == (task, labels)]
            first = [cell for cell in own if (cell["method"], cell["protocol"]) == (reference, "simulation")]
            alone = [cell for cell in own if METHODS[cell["method"]].labelled_only and cell["method"] != reference]
            if first and alone and all(map(_whole, [*first, *alone])):
                rate, *others = (round(cell["success_rate"], 9) for cell in [*first, *alone])  # means round differently
                sides["ahead" if rate > max(others) else "behind"].append(task)
                if {cell["method"] for cell in alone} <= _worse(result, first[0]):
                    sides["surely"].append(task)
        found += [sides] if sides["ahead"] or sides["behind"] else []
    return found


def _worse(result: Result, reference: Result) -> set[str]:
    """Methods that are behind the reference's cell by an interval that leaves out 0."""
    at = ("protocol", "demos", "labels")
    rows = [row for row in result["differences"] if all(row[name] == reference[name] for name in at)]
    return {row["method"] for row in rows if row["leaves_out_0"] and row["difference"] < 0}


def _whole(cell: Result) -> bool:
    return cell["runs"] == cell["of"] and cell["success_rate"] is not None


def task_sections(joint: Result) -> list[Section]:
    """A table of tasks and methods for each number of labels, then one of the methods that have no such number."""
    numbers = {cell["labels"] for cell in joint["cells"]}
    return [
        Section(
            f"Over tasks, with {labels} labelled demonstrations" if labels else "Over tasks",
            _blocks(joint, labels),
        )
        for labels in sorted(numbers, key=lambda n: (n is None, n))
    ]


def _blocks(joint: Result, labels: int | None) -> list[Block]:
    own = [cell for cell in joint["cells"] if cell["labels"] == labels]
    methods = dict.fromkeys((cell["method"], cell["protocol"]) for cell in own)
    there = {(cell["env"], cell["method"], cell["protocol"]): cell for cell in own}
    rows = {(row["method"], row["protocol"]): row for row in joint["rows"] if row["labels"] == labels}
    body = [[task, *(_cell(there.get((task, *method))) for method in methods)] for task in joint["tasks"]]
    means = [rate_text(row["score"], row["ci95"], unit="") if (row := rows.get(method)) else "–" for method in methods]
    body.append([IQM, *means])
    titles = [METHODS[name].title + ("" if at == "simulation" else f", {at}") for name, at in methods]
    missing = any(cell["runs"] < cell["of"] for cell in own)
    caption = "In brackets 95 % intervals."
    if videos := sorted({cell["demos"] for cell in own if not METHODS[cell["method"]].labelled_only} - {None}):
        caption += f" Of {' or '.join(map(str, videos))} demonstrations, the most there are, where not of labels alone."
    caption += " A mean is of methods that have all runs of all tasks." if missing else ""
    apart = {(row["method"], row["protocol"]): row for row in joint["differences"] if row["labels"] == labels}
    if apart:
        caption += " Differences are means over tasks, on pairs of the same world model, seed and episode."
        texts = [points_text(row["difference"], row["ci95"]) if (row := apart.get(m)) else "–" for m in methods]
        body.append([f"less {METHODS[joint['reference']].title}, points", *texts])
    blocks: list[Block] = [Table(["success, %", *titles], body, caption)]
    for sides in (sides for sides in joint["ahead"] if sides["labels"] == labels):
        where = f"; not in {', '.join(sides['behind'])}" if sides["behind"] else ""
        of = f"{len(sides['ahead']) + len(sides['behind'])} tasks{' that have all runs' if missing else ''}"
        title, ahead = METHODS[joint["reference"]].title, len(sides["ahead"])
        said = f"{title} is ahead of all methods on the labels alone in {ahead} of {of}"
        blocks.append(Text(f"{said}, by intervals that leave out 0 in {len(sides['surely'])}{where}."))
    return blocks


def _cell(cell: Result | None) -> str:
    if cell is None:
        return "–"
    what = "policies" if cell["worlds"] > 1 else "seeds"
    note = f"{cell['runs']} of {cell['of']} {what}" if cell["runs"] < cell["of"] else ""
    if cell["success_rate"] is None:
        return f"– ({note})" if note else "–"
    return rate_text(cell["success_rate"], cell["ci95"], f"; {note}" if note else "", unit="")


def tasks_page(result: Result) -> Document:
    """The page of a comparison of several tasks; each has its own in its folder."""
    tasks = result["across_tasks"]["tasks"]
    choice = "**On development blocks**: choices are made on them, so that these numbers are no test." if any(
        block["kind"] == "development" for block in result["blocks"]
    ) else "On test blocks."  # fmt: skip
    lead = (
        f"Preset `{result['preset']}`, training seeds {', '.join(map(str, result['seeds']))}, {result['episodes']} "
        f"held-out episodes a task, of which each has its own world models, and a page `TASK/comparison.md`. {choice} "
        f"The {IQM} is over the policies of all tasks."
    )
    errors = [f"**{task}: {error}**" for task, error in result["errors"].items()]
    done = [cell for cell in result["across_tasks"]["cells"] if cell["runs"]]
    if returns := dict.fromkeys(cell["env"] for cell in done if cell["success_rate"] is None):
        errors.append(f"Of {', '.join(returns)} no success is measured, but the return, in `TASK/comparison.md`.")
    sections = [
        *task_sections(result["across_tasks"]),
        Section(FOOTNOTES, [Notes([*errors, f"{machine_note(result)}."])]),
    ]
    return Document(f"Success over {len(tasks)} tasks", lead, sections, [Linked("Success rate", "comparison.png")])
