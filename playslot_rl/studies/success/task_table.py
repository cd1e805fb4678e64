"""Success over tasks: what several comparisons say together, as values, and as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from playslot_rl.config.methods import METHODS
from playslot_rl.studies.study import FOOTNOTES, Result, machine_note
from playslot_rl.studies.success.summary import across_tasks, largest
from playslot_rl.visualization.document import Block, Document, Linked, Notes, Section, Table, Text

IQM = "interquartile mean"


def joint_table(results: Sequence[Result], reference: str | None) -> dict[str, Any]:
    """`tasks`; `summary`, every task's with its `env`; `rows`, the interquartile means over them; and `ahead`, of each
    number of labels the tasks in which the reference in simulation beats every method on these labels alone, and the
    others.
    """
    return {
        "tasks": [result["env"] for result in results],
        "rows": across_tasks(results),
        "summary": [{"env": result["env"], **row} for result in results for row in result["summary"]],
        "reference": reference,
        "ahead": _ahead(results, reference),
    }


def _ahead(results: Sequence[Result], reference: str | None) -> list[dict[str, Any]]:
    found = []
    tasks = {result["env"]: _rates(result["summary"]) for result in results}
    for labels in sorted({key[2] for rates in tasks.values() for key in rates} - {None}):
        sides: dict[str, Any] = {"labels": labels, "ahead": [], "behind": []}
        for task, rates in tasks.items():
            own = rates.get((reference, "simulation", labels))
            alone = [rate for (name, _, n), rate in rates.items() if n == labels and METHODS[name].labelled_only]
            if own is not None and alone:
                sides["ahead" if own > max(alone) else "behind"].append(task)
        found += [sides] if sides["ahead"] or sides["behind"] else []
    return found


def _rates(summary: Sequence[Result]) -> dict[tuple[Any, ...], float]:
    return {key: round(row["success_rate"], 9) for key, (row,) in largest(summary).items()}  # means round differently


def task_sections(joint: Result) -> list[Section]:
    """A table of tasks and methods for each number of labels, then one of the methods that have no such number."""
    numbers = {row["labels"] for row in joint["summary"]}
    return [
        Section(
            f"Over tasks, with {labels} labelled demonstrations" if labels else "Over tasks",
            _blocks(joint, labels),
        )
        for labels in sorted(numbers, key=lambda n: (n is None, n))
    ]


def _blocks(joint: Result, labels: int | None) -> list[Block]:
    own = [row for row in joint["summary"] if row["labels"] == labels]
    methods = dict.fromkeys((row["method"], row["protocol"]) for row in own)
    rows = {(row["method"], row["protocol"]): row for row in joint["rows"] if row["labels"] == labels}
    body = []
    for task in joint["tasks"]:
        there = {key[:2]: row for key, (row,) in largest([row for row in own if row["env"] == task]).items()}
        body.append([task, *(_cell(there.get(method), "success_rate") for method in methods)])
    body.append([IQM, *(_cell(rows.get(method), "score") for method in methods)])
    titles = [METHODS[name].title + ("" if at == "simulation" else f", {at}") for name, at in methods]
    blocks: list[Block] = [Table(["success, %", *titles], body, "In brackets 95 % intervals.")]
    for sides in (sides for sides in joint["ahead"] if sides["labels"] == labels):
        where = f"; not in {', '.join(sides['behind'])}" if sides["behind"] else ""
        of = len(sides["ahead"]) + len(sides["behind"])
        said = (
            f"{METHODS[joint['reference']].title} is ahead of all methods on the labels alone in {len(sides['ahead'])}"
        )
        blocks.append(Text(f"{said} of {of} tasks{where}."))
    return blocks


def _cell(row: Result | None, key: str) -> str:
    if row is None:
        return "–"
    low, high = row["ci95"]
    return f"{100 * row[key]:.0f} ({100 * low:.0f} to {100 * high:.0f})"


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
    sections = [
        *task_sections(result["across_tasks"]),
        Section(FOOTNOTES, [Notes([*errors, f"{machine_note(result)}."])]),
    ]
    return Document(f"Success over {len(tasks)} tasks", lead, sections, [Linked("Success rate", "comparison.png")])
