"""`comparison.md`: success against demonstrations, labels or videos and against environment steps, with footnotes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from playslot_rl.config.methods import METHODS, stage_named
from playslot_rl.evaluation.actions import error_text
from playslot_rl.evaluation.intervals import in_bold, points_text, rate_text
from playslot_rl.runtime.progress import format_seconds
from playslot_rl.studies.study import FOOTNOTES, Result, machine_note, open_jobs_notes, origin_notes
from playslot_rl.studies.success.errors import error_references
from playslot_rl.studies.success.task_table import task_sections
from playslot_rl.visualization.document import Block, Document, Linked, Notes, Section, Table, Text

UNITS = {"demos": "demonstrations", "labels": "labelled", "videos": "videos"}


class Panel(NamedTuple):
    """A table and a panel of the plot, over numbers of `axis`: `demos`, `labels` or `videos`. Rows of the summary,
    of the differences and of the jobs have their number as `at`; None is one row for all of them.
    """

    title: str
    heading: str
    axis: str
    alike: str
    rows: Sequence[Result]
    differences: Sequence[Result]
    jobs: Sequence[Result]


def success_page(result: Result) -> Document:
    if result.get("measure") == "actions":
        return _errors_page(result)
    worlds, block = result["worlds"], result["block"]
    lead = (
        f"Preset `{result['preset']}`, world models {worlds}, training seeds {_list(result['seeds'])}, "
        f"{result['episodes']} held-out episodes, the same for all, at most {result['max_steps']} agent steps. "
        f"{_block(block)} Success is the mean over the trained policies; in brackets its 95 % bootstrap interval over "
        f"{_levels(result)}, and the lowest and the highest policy."
    )
    sections = [
        *(_section(panel, result) for panel in panels(result)),
        *_by_acting(result),
        *(task_sections(result["across_tasks"]) if result["across_tasks"] else []),
        *_returns(result),
        Section(FOOTNOTES, [Notes(_footnotes(result))]),
        Section("Every job", [_jobs(result["rows"])]),
    ]
    against = "videos" if result["videos"] else "labels" if result["labels"] else "demonstrations"
    title = f"{result['env']}: success against {against}"
    title += ", on a development block" if block["kind"] == "development" else ""
    return Document(title, lead, sections, [Linked("Success rate", "comparison.png")])


def _errors_page(result: Result) -> Document:
    lead = (
        f"Preset `{result['preset']}`, world models {result['worlds']}, training seeds {_list(result['seeds'])}. "
        f"Without a simulator each policy acts at the frames of the last {result['held_out']} demonstrations, the same "
        "for all, which nothing was trained on. The error is the mean absolute one over the dimensions, in the data "
        f"set's units; in brackets its 95 % bootstrap interval over {_levels(result)}. R2 is 0 for the mean labelled "
        "action, 1 for no error. It is no success: a small error may still fail, and another action may succeed."
    )
    sections = [_section(panel, result) for panel in panels(result)]
    sections += [Section(FOOTNOTES, [Notes(_footnotes(result))]), Section("Every job", [_jobs(result["rows"])])]
    title = f"{result['env']}: error of actions on held-out demonstrations"
    return Document(title, lead, sections, [Linked("Error of actions", "comparison.png")])


def _levels(result: Result) -> str:
    """What intervals are over."""
    several = result["worlds"] > 1
    return "world models, seeds and episodes" if several else "seeds and episodes, of one world model"


def _block(block: Result) -> str:
    if block["kind"] == "development":
        return (
            f"**Block {block['number']} is a development block**: choices are made on it, so that these numbers are no "
            "test (`compare.block=test`)."
        )
    when = f", drawn on {block['date']} at commit {block['commit'] or 'unknown'}" if "date" in block else ""
    return f"Block {block['number']} is a test block{when}."


def panels(result: Result) -> list[Panel]:
    """One for each number of labels where videos are on the axis, for each number of videos where labels are, or one;
    none where no method learns from demonstrations.
    """
    rows = [row for row in result["summary"] if row["demos"] is not None]
    if not rows:
        return []
    if result["videos"]:
        return [_of_videos(result, rows, labels) for labels in sorted(result["labels"])]
    if not result["labels"]:
        jobs, apart = result["rows"], result["differences"]
        sides = [[{**row, "at": row["demos"]} for row in side if row["demos"]] for side in (rows, apart, jobs)]
        return [Panel("", "By demonstrations", "demos", "", sides[0], sides[1], sides[2])]
    videos = sorted({row["demos"] for row in rows if not METHODS[row["method"]].labelled_only})
    return [_of_labels(result, rows, number) for number in videos or [None]]


def _of_labels(result: Result, rows: Sequence[Result], videos: int | None) -> Panel:
    """Methods by labelled demonstrations of so many videos; oracles, which see all actions, are alike for all."""

    def own(side: Sequence[Result]) -> list[Result]:
        there = [row for row in side if row["demos"] == videos or METHODS[row["method"]].labelled_only]
        return [{**row, "at": row["labels"]} for row in there]

    heading = f"By labelled demonstrations{f', of {videos} videos' if videos else ''}"
    all_of = f"With the actions of all {videos}"
    apart = [row for row in result["differences"] if row["demos"] == videos or _without_videos(row, result)]
    apart = [{**row, "at": row["labels"]} for row in apart]
    return Panel(f"{videos} videos" if videos else "", heading, "labels", all_of, own(rows), apart, own(result["rows"]))


def _without_videos(difference: Result, result: Result) -> bool:
    """Whether neither side of a difference learns from unlabelled videos."""
    reference = METHODS[result["reference"]].labelled_only
    return reference and (difference["demos"] is None or METHODS[difference["method"]].labelled_only)


def _of_videos(result: Result, rows: Sequence[Result], labels: int) -> Panel:
    """Methods by unlabelled videos beside so many labels; what learns from the labels alone is alike for all."""

    def own(side: Sequence[Result]) -> list[Result]:
        there: list[Result] = []
        for row in (row for row in side if row["labels"] in (None, labels) and row["demos"]):
            if "difference" in row and _without_videos(row, result):  # in every column
                there += [{**row, "at": number} for number in result["videos"]]
                continue
            alone = METHODS[row["method"]].labelled_only and "difference" not in row
            at = None if alone else row["demos"] - labels
            if at is None or at in result["videos"]:
                there.append({**row, "at": at})
        return there

    heading = f"By unlabelled videos, beside {labels} labelled demonstrations"
    sides = own(rows), own(result["differences"]), own(result["rows"])
    return Panel(f"{labels} labels", heading, "videos", "From the labels alone", *sides)


def _section(panel: Panel, result: Result) -> Section:
    rows = [*panel.rows, *error_references(panel.rows)]
    blocks: list[Block] = [_table(rows, panel.axis, [cell(row, result) for row in rows])]
    alike = [f"{row['title']} {cell(row, result)}" for row in panel.rows if row["at"] is None]
    if alike:
        blocks.append(Text(f"{panel.alike}: {'; '.join(alike)}."))
    if panel.differences:
        title, errors = METHODS[result["reference"]].title, result.get("measure") == "actions"
        what = f"Points more or less than {title} in simulation"
        if errors:
            what = f"Error less that of {title} (below 0 is better than {title}, above 0 is worse)"
        caption = (
            f"{what}, on pairs of the same world model, seed and episode; bold where the 95 % interval leaves out 0."
        )
        table = _table(panel.differences, panel.axis, [_apart(row, result) for row in panel.differences])
        blocks.append(Table([f"less {title}", *table.headers[1:]], table.rows, caption))
    return Section(panel.heading, blocks)


def _table(rows: Sequence[Result], axis: str, texts: Sequence[str]) -> Table:
    """Methods and protocols by the number on the axis; rows without one are left out."""
    cells = {(row["title"], row["protocol"], row["at"]): text for row, text in zip(rows, texts, strict=True)}
    numbers = sorted({row["at"] for row in rows} - {None})
    series = dict.fromkeys((row["title"], row["protocol"]) for row in rows if row["at"] is not None)
    body = [[t if p == "actions" else f"{t}, {p}", *(cells.get((t, p, n), "–") for n in numbers)] for t, p in series]
    what = "error of actions" if any("mae" in row for row in rows) else ""
    return Table([what, *(f"{n:,} {UNITS[axis]}" for n in numbers)], body)


def _apart(row: Result, result: Result) -> str:
    """`+35 (28 to 42)`, in points of success or in units of the error, bold where 0 is left out; and of how many seeds,
    if not all."""
    there = len(row["seeds"])
    own = f" (of {there} seed{'s' * (there > 1)})" if there < _seeds(row, result) else ""
    if result.get("measure") != "actions":
        return points_text(row["difference"], row["ci95"]) + own
    return in_bold([f"{number:+.3g}" for number in (row["difference"], *row["ci95"])], row["leaves_out_0"]) + own


def _seeds(row: Result, result: Result) -> int:
    """How many a method and the reference have in common, finished or not."""
    both = (row["method"], result["reference"])
    mine, theirs = ({job["seed"] for job in result["rows"] if job["method"] == method} for method in both)
    return len(mine & theirs)


def _by_acting(result: Result) -> list[Section]:
    rows = [row for row in result["summary"] if row["demos"] is None]
    if not rows:
        return []
    body = [[budgeted(row, result), _number(row["env_steps"]), cell(row, result)] for row in rows]
    return [Section("By acting", [Table(["", "environment steps", "success"], body)])]


def budgeted(row: Result, result: Result) -> str:
    """A method that acts is only as good as its time: `DreamerV3, 1 h 00 min on 2 cores`; the cores are its threads."""
    spent, cores = row["train_seconds"], result["threads"] or result["hardware"]["cores"]
    if spent is None:
        return str(row["title"])
    return f"{row['title']}, {format_seconds(spent)} on {cores} core{'s' if cores > 1 else ''}"


def cell(row: Result, result: Result) -> str:
    """Rate, interval and range: `97 % (93 to 99; seeds 96 to 98)`; and how many policies there are, if not all."""
    if "runs" not in row:  # what policies are held against
        return error_text(row)
    what, note = "policies" if len(row["worlds"]) > 1 else "seeds", ""
    if row["runs"] > 1 and "mae" not in row:
        note = f"; {what} {100 * row['lowest']:.0f} to {100 * row['highest']:.0f}"
    own = [job for job in result["rows"] if all(job[key] == row[key] for key in ("method", "demos", "labels"))]
    wanted = len({job["name"] for job in own})
    if row["runs"] < wanted:
        note += f"; {row['runs']} of {wanted} {what}"
    if "mae" in row:
        return error_text(row) + note
    return rate_text(row["success_rate"], row["ci95"], note)


def _footnotes(result: Result) -> list[str]:
    rows: Sequence[Result] = result["rows"]
    done = [row for row in rows if row["status"] == "done"]
    notes = [f"{name}: {_reference(value)}, on the same episodes." for name, value in result["references"].items()]
    notes += _ratios(result["summary"])
    notes += [
        f"Labels: {title} saw the real actions of {said}." for title in _titles(done) if (said := _labels(done, title))
    ]
    notes += _acting_cost(result)
    notes += [f"{title} starts from {_list(values)} weights." for title, values in _values(done, "pretraining").items()]
    shares = {title: (f"{100 * v[0]:.0f}", f"{100 * v[-1]:.0f}") for title, v in _values(done, "kept_rows").items()}
    kept = [f"{t} {least} %" if least == most else f"{t} {least} to {most} %" for t, (least, most) in shares.items()]
    sizes, samples = (
        [f"{title} {_list(map(_number, values))}" for title, values in _values(done, key).items()]
        for key in ("parameters", "samples")
    )
    for what, parts in (
        ("Parameters, those of the models it builds on included", sizes),
        ("Rows learned from; still stretches of the videos are left out", kept),
        (
            "Training of the policy, optimiser steps times batch (decoder and fine-tuning, which follow, not counted)",
            samples,
        ),
    ):
        notes += [f"{what}: {'; '.join(parts)}."] if parts else []
    notes.append(_times(done, result))
    notes += [*_shared(result), *origin_notes(rows)]
    return [*notes, *open_jobs_notes(rows, "jobs"), f"{machine_note(result)}."]


def _acting_cost(result: Result) -> list[str]:
    notes = []
    for row in result["summary"]:
        if row["demos"] is None and row["agent_steps"] is not None:
            prior = ", those of the videos its slots were trained on included" if METHODS[row["method"]].slots else ""
            notes.append(
                f"{row['title']}: {row['env_steps']:,} environment steps, which are {row['agent_steps']:,} agent steps "
                f"of {result['frame_skip']}{prior}; mean over the seeds."
            )
    return notes


def _shared(result: Result) -> list[str]:
    """Models that were trained once, on unlabelled videos, for all demonstrations and seeds."""
    notes = []
    rest = "the same for every number of demonstrations and every seed"
    if result["learn_from_demos"]:
        rest += "; the preset's own demonstrations are among them, as videos"
    if result["videos"]:
        rest += ", and in every column: the videos on the axis are those that a policy clones"
    for world in result["world_models"]:
        notes.append(
            f"World model of the methods on slots ({world['source']}; slots {world['fingerprints']['slots']}): "
            f"{world['seconds']:.0f} s of training on {world['episodes']} videos without actions, {rest}."
        )
    for stage, models in result["latent_models"].items():
        seconds = ", ".join(f"{model['seconds']:.0f}" for model in models)
        notes.append(
            f"{stage_named(stage).title}: {seconds} s of training on {models[0]['episodes']} videos without actions, "
            f"{rest}."
        )
    models = [METHODS[method].model for method in dict.fromkeys(row["method"] for row in result["rows"])]
    own = [model.title for model in models if model and model.labels and model.name not in result["latent_models"]]
    return [*notes, *(f"{title}: trained in every job, whose labels count in it, and in its time." for title in own)]


def _ratios(summary: Sequence[Result]) -> list[str]:
    """PlaySlot's success in simulation as a share of the Slot Oracle's, which sees all real actions."""
    rates = {
        (row["method"], row["demos"]): row["success_rate"]
        for row in summary
        if row["protocol"] == "simulation" and row["labels"] is None
    }
    shares = [
        f"{100 * rate / rates['slot_oracle', demos]:.0f} % at {demos}"
        for (method, demos), rate in rates.items()
        if METHODS[method].imagines and rates.get(("slot_oracle", demos))
    ]
    if not shares:
        return []
    return [f"PlaySlot's success in simulation over the Slot Oracle's: {', '.join(shares)} demonstrations."]


def _titles(rows: Sequence[Result]) -> list[str]:
    return list(dict.fromkeys(row["title"] for row in rows))


def _labels(rows: Sequence[Result], title: str) -> str:
    found: dict[int, set[int]] = {}
    for row in rows:
        if row["title"] == title and row["demos"] is not None and row["labelled_demos"] is not None:
            found.setdefault(row["demos"], set()).add(row["labelled_demos"])
    said = _list(f"{_list(sorted(labels))} of {demos}" for demos, labels in sorted(found.items()))
    return f"{said} demonstrations" if said else ""


def _values(rows: Sequence[Result], key: str) -> dict[str, list[Any]]:
    """The values of a key in rising order, by title, where there are any."""
    found: dict[str, set[Any]] = {}
    for row in rows:
        if row.get(key) is not None:
            found.setdefault(row["title"], set()).add(row[key])
    return {title: sorted(values) for title, values in found.items()}


def _times(rows: Sequence[Result], result: Result) -> str:
    parts = []
    for title in _titles(rows):
        unique = {row["name"]: row for row in rows if row["title"] == title}
        trained = [row["train_seconds"] or 0.0 for row in unique.values()]
        played = sum(row["evaluation_seconds"] or 0.0 for row in rows if row["title"] == title)
        mean = sum(trained) / len(trained)
        parts.append(f"{title} {mean:.0f} s a training, {played / len(unique):.0f} s its evaluation")
    whole = f"{result['seconds']:.0f} s of wall time for the whole, data and world model included where they were made"
    return f"Time: {'; '.join([*parts, whole])}."


def _returns(result: Result) -> list[Section]:
    """Of a task without success: mean return over the seeds; empty for others."""
    groups: dict[tuple[str, ...], list[float]] = {}
    for row in result["rows"]:
        if "mean_return" in row:
            name = (row["title"], row["protocol"], _number(row["demos"]), _number(row["labels"]))
            groups.setdefault(name, []).append(row["mean_return"])
    if not groups:
        return []
    body = [
        [*name, f"{sum(found) / len(found):.2f} ({min(found):.2f} to {max(found):.2f})"]
        for name, found in groups.items()
    ]
    return [Section("Return", [Table(["", "protocol", "demonstrations", "labels", "return (of the seeds)"], body)])]


def _reference(value: Result) -> str:
    if value["success_rate"] is None:
        return f"return {value['mean_return']:.2f}" if "mean_return" in value else "not run"
    return rate_text(value["success_rate"], value["ci95"])


def _outcome(row: Result) -> str:
    if "mae" in row:
        return error_text(row)
    if row["success_rate"] is None:
        return f"return {row['mean_return']:.2f}" if "mean_return" in row else "–"
    return f"{row['successes']} of {row['episodes']}"


def _jobs(rows: Sequence[Result]) -> Table:
    outcome = "error" if any("mae" in row for row in rows) else "success"
    headers = ["job", "protocol", "status", outcome, "labels", "environment steps", "training", "evaluation"]
    body = [
        [
            row["name"],
            row["protocol"],
            row["status"],
            _outcome(row),
            _number(row["labelled_demos"]),
            _number(row["env_steps"]),
            "–" if row["train_seconds"] is None else f"{row['train_seconds']:.0f} s",
            "–" if row["evaluation_seconds"] is None else f"{row['evaluation_seconds']:.0f} s",
        ]
        for row in rows
    ]
    return Table(headers, body)


def _number(value: object) -> str:
    if value is None:
        return "–"
    return f"{value:,}" if isinstance(value, int) else str(value)


def _list(values: Iterable[object]) -> str:
    return ", ".join(map(str, values))
