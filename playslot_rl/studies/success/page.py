"""`comparison.md`, and `comparison.png` and `.svg`: success against demonstrations or labels and against environment
steps, with footnotes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from playslot_rl.config.methods import METHODS, stage_title
from playslot_rl.runtime.progress import format_seconds
from playslot_rl.studies.study import FOOTNOTES, Result, machine_note, open_jobs_notes
from playslot_rl.visualization.charts import Theme, legend, new_figure, step_axis, style_axes
from playslot_rl.visualization.document import Block, Document, Linked, Notes, Section, Table, Text

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def success_page(result: Result) -> Document:
    lead = (
        f"Preset `{result['preset']}`, training seeds {_list(result['seeds'])}, {result['episodes']} held-out episodes "
        f"(block {result['evaluation_seed']} of the evaluation seeds, the same for every method and seed), at most "
        f"{result['max_steps']} agent steps. Success is the mean over the training seeds; in brackets its 95 % Wilson "
        "interval over the episodes, which all seeds share, and after it the lowest and the highest seed."
    )
    sections = [
        *(_by_labels if result["labels"] else _by_demonstrations)(result["summary"], len(result["seeds"])),
        *_by_acting(result),
        Section(FOOTNOTES, [Notes(_footnotes(result))]),
        Section("Every job", [_jobs(result["rows"])]),
    ]
    title = f"{result['env']}: success against {'labels' if result['labels'] else 'demonstrations'}"
    return Document(title, lead, sections, [Linked("Success rate", "comparison.png")])


def _by_demonstrations(summary: Sequence[Result], seeds: int) -> list[Section]:
    rows = [row for row in summary if row["demos"] is not None]
    if not rows:
        return []
    return [Section("By demonstrations", [_success_table(rows, "demos", "demonstrations", seeds)])]


def _by_labels(summary: Sequence[Result], seeds: int) -> list[Section]:
    """A table for each number of videos: methods by labelled demonstrations, and the oracles, which see all actions."""
    rows = [row for row in summary if row["demos"] is not None]
    sections = []
    for videos in sorted({row["demos"] for row in rows if not METHODS[row["method"]].labelled_only}) or [None]:
        own = [row for row in rows if METHODS[row["method"]].labelled_only or row["demos"] == videos]
        blocks: list[Block] = [_success_table(own, "labels", "labelled", seeds)]
        ceiling = [f"{row['title']} {cell(row, seeds)}" for row in own if row["labels"] is None]
        if ceiling:
            blocks.append(Text(f"With the actions of all {videos}: {'; '.join(ceiling)}."))
        sections.append(Section(f"By labelled demonstrations{f', of {videos} videos' if videos else ''}", blocks))
    return sections


def _success_table(rows: Sequence[Result], key: str, unit: str, seeds: int) -> Table:
    """Methods and protocols by `demos` or `labels`; rows without that number are left out."""
    own = [row for row in rows if row[key] is not None]
    numbers = sorted({row[key] for row in own})
    cells = {(row["title"], row["protocol"], row[key]): cell(row, seeds) for row in own}
    series = dict.fromkeys((row["title"], row["protocol"]) for row in own)
    body = [[f"{t}, {p}", *(cells.get((t, p, n), "–") for n in numbers)] for t, p in series]
    return Table(["", *(f"{n} {unit}" for n in numbers)], body)


def _by_acting(result: Result) -> list[Section]:
    rows = [row for row in result["summary"] if row["demos"] is None]
    if not rows:
        return []
    seeds = len(result["seeds"])
    body = [[budgeted(row, result), _number(row["env_steps"]), cell(row, seeds)] for row in rows]
    return [Section("By acting", [Table(["", "environment steps", "success"], body)])]


def budgeted(row: Result, result: Result) -> str:
    """A method that acts is only as good as its time: `DreamerV3, 1 h 00 min on 2 cores`; the cores are its threads."""
    spent, cores = row["train_seconds"], result["threads"] or result["hardware"]["cores"]
    if spent is None:
        return str(row["title"])
    return f"{row['title']}, {format_seconds(spent)} on {cores} core{'s' if cores > 1 else ''}"


def cell(row: Result, seeds: int) -> str:
    """Rate, interval and range of the seeds: `97 % (93 to 99; seeds 96 to 98)`; and how many of `seeds`, if not all."""
    low, high = (100 * end for end in row["ci95"])
    text = f"{100 * row['success_rate']:.0f} % ({low:.0f} to {high:.0f}"
    if len(row["seeds"]) > 1:
        text += f"; seeds {100 * row['lowest']:.0f} to {100 * row['highest']:.0f}"
    if len(row["seeds"]) < seeds:
        text += f"; {len(row['seeds'])} of {seeds} seeds"
    return f"{text})"


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
    notes += _shared(result)
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
    notes, world = [], result.get("world_model")
    rest = "the same for every number of demonstrations and every seed"
    if result["learn_from_demos"]:
        rest += "; the preset's own demonstrations are among them, as videos"
    if world:
        notes.append(
            f"World model of the methods on slots ({world['source']}; slots {world['fingerprints']['slots']}): "
            f"{world['seconds']:.0f} s of training on {world['episodes']} videos without actions, {rest}."
        )
    for stage, model in result["latent_models"].items():
        notes.append(
            f"{stage_title(stage)}: {model['seconds']:.0f} s of training on {model['episodes']} videos without "
            f"actions, {rest}."
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


def _reference(value: Result) -> str:
    if value["success_rate"] is None:
        return "not run"
    low, high = value["ci95"]
    return f"{100 * value['success_rate']:.0f} % ({100 * low:.0f} to {100 * high:.0f})"


def _jobs(rows: Sequence[Result]) -> Table:
    headers = ["job", "protocol", "status", "success", "labels", "environment steps", "training", "evaluation"]
    body = [
        [
            row["name"],
            row["protocol"],
            row["status"],
            "–" if row["success_rate"] is None else f"{row['successes']} of {row['episodes']}",
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


def success_figure(result: Result, theme: Theme) -> Figure:
    """Draw what `comparison.json` holds.

    A method has its colour and marker everywhere; imagination is dashed. Bars are 95 % Wilson intervals over the
    episodes, which all seeds share, small dots are single seeds, the grey lines the references.
    """
    offline = [row for row in result["summary"] if row["demos"] is not None]
    curves = [row for row in result["rows"] if row["curve"]]
    final = [row for row in result["summary"] if row["demos"] is None]
    online = bool(curves or final)
    groups = _panels(result, offline) or ([] if online else [("", [])])
    panels = len(groups) + int(online)
    figure = new_figure(9.6 if panels > 1 else 6.4, 3.9)
    for number, (title, rows) in enumerate(groups, 1):
        axes = figure.add_subplot(1, panels, number)
        axes.set_title(title, color=theme.text, fontsize=10)
        _against(axes, rows, result["rows"], theme, "labels" if result["labels"] else "demos")
        _finish(axes, result, theme)
    if online:
        axes = figure.add_subplot(1, panels, panels)
        _steps(axes, curves, [{**row, "title": budgeted(row, result)} for row in final], theme)
        _finish(axes, result, theme)
    legend(figure, theme, loc="outside lower center", ncols=3, fontsize=9)
    return figure


def _panels(result: Result, offline: Sequence[Result]) -> list[tuple[str, Sequence[Result]]]:
    """Title and rows of each panel of the methods that learn from demonstrations: by labels, one a number of videos."""
    if not result["labels"]:
        return [("", offline)] if offline else []
    videos = sorted({row["demos"] for row in offline if not METHODS[row["method"]].labelled_only})
    if not videos:
        return [("", offline)] if offline else []
    return [
        (f"{n} videos", [row for row in offline if METHODS[row["method"]].labelled_only or row["demos"] == n])
        for n in videos
    ]


def _against(axes: Axes, summary: Sequence[Result], rows: Sequence[Result], theme: Theme, key: str) -> None:
    """Success over `demos` or `labels`; what has no such number, oracles among labels, is a line across."""
    for row in (row for row in summary if row[key] is None):
        colour = theme.series[METHODS[row["method"]].style.colour]
        axes.axhline(100 * row["success_rate"], color=colour, linestyle="-.", linewidth=1.2, label=row["title"])
    summary = [row for row in summary if row[key] is not None]
    shown = {(row["method"], row["protocol"], row["demos"]) for row in summary}
    series = list(dict.fromkeys((row["method"], row["protocol"], row["title"]) for row in summary))
    numbers = sorted({row[key] for row in summary})
    for index, (method, protocol, title) in enumerate(series):
        style, own = METHODS[method].style, [r for r in summary if (r["method"], r["protocol"]) == (method, protocol)]
        own.sort(key=lambda row: row[key])
        # Side by side, so that equal rates do not hide each other; by a factor, since the axis is logarithmic.
        aside = 1.035 ** (index - (len(series) - 1) / 2)
        x, y = [row[key] * aside for row in own], [100 * row["success_rate"] for row in own]
        below = [max(0.0, 100 * (row["success_rate"] - row["ci95"][0])) for row in own]
        above = [max(0.0, 100 * (row["ci95"][1] - row["success_rate"])) for row in own]
        dream = protocol == "imagination"
        colour = theme.series[style.colour]
        axes.errorbar(
            x, y, [below, above], color=colour, marker=style.marker, markersize=6, linewidth=1.6,
            linestyle="--" if dream else "-", markerfacecolor=theme.ground if dream else colour, capsize=2,
            elinewidth=1.2, label=f"{title}, imagination" if dream else title,
        )  # fmt: skip
        single = [
            r
            for r in rows
            if (r["method"], r["protocol"]) == (method, protocol)
            and (method, protocol, r["demos"]) in shown
            and r["success_rate"] is not None
        ]
        if len({row["seed"] for row in single}) > 1:
            dots = [row[key] * aside for row in single]
            axes.plot(dots, [100 * row["success_rate"] for row in single], ".", color=colour, markersize=4, alpha=0.5)
    axes.set_xscale("log")
    axes.set_xticks(numbers, [str(n) for n in numbers])
    axes.minorticks_off()
    axes.set_xlabel("labelled demonstrations" if key == "labels" else "demonstrations")


def _steps(axes: Axes, curves: Sequence[Result], final: Sequence[Result], theme: Theme) -> None:
    for method in dict.fromkeys(row["method"] for row in [*curves, *final]):
        style = METHODS[method].style
        colour = theme.series[style.colour]
        own = [row for row in curves if row["method"] == method]
        for row in own:
            points = [p for p in row["curve"] if p.get("success_rate") is not None and p.get("env_steps") is not None]
            x = [p["env_steps"] for p in points]
            axes.plot(x, [100 * p["success_rate"] for p in points], color=colour, linewidth=1.2, alpha=0.6)
        for end in (row for row in final if row["method"] == method and row["env_steps"] is not None):
            low, high = end["ci95"]
            error = [[100 * (end["success_rate"] - low)], [100 * (high - end["success_rate"])]]
            axes.errorbar(
                [end["env_steps"]], [100 * end["success_rate"]], error, color=colour, marker=style.marker,
                markersize=7, linestyle="none", capsize=2, label=end["title"],
            )  # fmt: skip
        dots = [r for r in own if r["env_steps"] is not None and r["success_rate"] is not None]
        if len(dots) > 1:
            rates = [100 * r["success_rate"] for r in dots]
            axes.plot([r["env_steps"] for r in dots], rates, ".", color=colour, markersize=4, alpha=0.5)
        if not any(row["method"] == method and row["env_steps"] is not None for row in final):
            axes.plot([], [], color=colour, marker=style.marker, label=(own or list(final))[0]["title"])
    step_axis(axes)
    axes.set_xlabel("environment steps (lines: development episodes)")


def _finish(axes: Axes, result: Result, theme: Theme) -> None:
    for name, line in (("expert", ":"), ("random", "--")):
        rate = result["references"].get(name, {}).get("success_rate")
        if rate is not None:
            axes.axhline(100 * rate, color=theme.series[7], linestyle=line, linewidth=1.2, label=f"{name} actions")
    axes.set_ylim(-3, 103)
    axes.set_ylabel("success rate, %")
    style_axes(axes, theme)
