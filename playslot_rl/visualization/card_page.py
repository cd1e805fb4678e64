"""The report card as a page of its own, and as a section of a run's report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from playslot_rl.evaluation.card import RESULT, Card
from playslot_rl.evaluation.card_lines import ACTIONS, EFFECTS, LATENTS, SLOTS, concluded
from playslot_rl.evaluation.effects import Replayed
from playslot_rl.frames import png
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.visualization.charts import usage_chart
from playslot_rl.visualization.document import Block, Document, Missing, Picture, Section, Table, Text
from playslot_rl.visualization.drawings import change_map, draw_slots
from playslot_rl.visualization.grid import image_grid
from playslot_rl.visualization.sections import ReportInput, chart
from playslot_rl.world_model import WorldModel

ROWS = 4
"""Windows shown."""
VERDICTS = {"good": "good", "fair": "fair", "bad": "BAD", "not measured": "not measured"}


def card_tables(lines: Sequence[Mapping[str, Any]]) -> list[tuple[str, Table]]:
    """One table a group of lines (`Line.plain`), with the group's name."""
    headers = ["measure", "value", "verdict", "good", "bad", "measured on"]
    groups = dict.fromkeys(str(one["group"]) for one in lines)
    return [(group, Table(headers, [_row(one) for one in lines if one["group"] == group])) for group in groups]


def _rounded(value: float | None) -> str:
    return "–" if value is None else f"{round(value, 2) + 0.0:.2f}"


def _row(one: Mapping[str, Any]) -> list[str]:
    note = f"not measured: {one['note']}" if one["value"] is None else str(one["note"])
    return [one["measure"], _rounded(one["value"]), VERDICTS[one["verdict"]], one["good"], one["bad"], note]


def verdict_text(result: Mapping[str, Any]) -> str:
    """`verdict: usable: replay 0.82; 12 good, 5 fair, 2 bad`."""
    counts = {v: sum(one["verdict"] == v for one in result["lines"]) for v in VERDICTS}
    counted = ", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)
    return f"{concluded(result)}; {counted}"


def told_text(result: Mapping[str, Any]) -> str:
    """Which episodes were measured, as sentences."""
    known = "" if result["held_out_known"] else " It is not known whether the world model has seen them."
    count = len(result["episodes_tested"])
    return (
        f"Measured on {count} episode{'' if count == 1 else 's'} of `{result['data']}`: {result['held_out']}.{known} "
        f"Probes are fitted on {result['episodes_fitted']} others."
    )


def card_document(result: Mapping[str, Any], card: Card, model: WorldModel) -> Document:
    """The page of `inspect`: of the card and its stored `result` (`card_json`)."""
    pictures = _pictures(card, model)
    sections = [Section(group, [table, *more, *pictures.get(group, [])]) for group, table, more in _groups(result)]
    lead = (
        f"World model of `{result['run']}`: {verdict_text(result)}. {told_text(result)} A verdict is a rule "
        "of thumb; the borders are in the columns `good` and `bad`, what lies between is fair."
    )
    return Document("PlaySlot report card", lead, sections)


def _groups(result: Mapping[str, Any]) -> list[tuple[str, Table, list[Block]]]:
    """Each group of lines, its table, and what a stored card has beside it."""
    details = result["details"]
    beside = {
        LATENTS: [*_usage(details.get("code_counts", [])), *_code_table(details.get("code_actions", []))],
        ACTIONS: [*_probe_table(details.get("probes", {})), *_slot_table(details.get("telling_slots", []))],
        EFFECTS: _prototype_table(details.get("prototypes", [])),
    }
    return [(group, table, beside.get(group, [])) for group, table in card_tables(result["lines"])]


def _pictures(card: Card, model: WorldModel) -> dict[str, list[Block]]:
    """Pictures by the group that they belong to."""
    found: dict[str, list[Block]] = {EFFECTS: [], SLOTS: []}
    if model.inverse_dynamics.latent_dim:
        found[EFFECTS] += _replay_pictures(card.replayed)
    source, first = card.parsed.source, int(np.flatnonzero(card.parsed.tested_episodes)[0])
    clip = np.asarray(source.frames[source.episode_rows(first)])
    alt = "Rows: frames, their reconstructions, the segmentation by slot, and the part of the frame each slot holds."
    found[SLOTS].append(Picture("slots", png(draw_slots(model, clip)), alt, "The first held-out episode, not chosen."))
    return found


def _replay_pictures(shown: Replayed) -> list[Block]:
    windows, steps = shown.windows, shown.windows.latents.shape[1]
    rows = np.unique(np.linspace(0, len(windows.frames) - 1, min(ROWS, len(windows.frames))).round().astype(int))
    labels = [f"window {row + 1}" for row in rows]
    blocks: list[Block] = []
    if shown.taken is not None:
        others = windows.others[rows]
        columns = [windows.frames[rows, 0], windows.frames[rows, -1], shown.own.frames[rows]]
        columns += [windows.frames[others, 0], shown.taken.frames[rows]]
        names = ["frame", f"true, t = {steps}", "imagined", "elsewhere", "same latents"]
        alt = (
            "Rows are windows: frame, true and imagined frames later, a frame of another episode, and what the same "
            "latents make of it."
        )
        caption = (
            f"Latents of {steps} steps in their own episode, and replayed from a frame of another. Windows are spread "
            "evenly, not chosen."
        )
        blocks.append(_grid("transfer", columns, labels, names, alt, caption))
    if shown.swapped is not None:
        own, swapped = shown.own.frames[rows], shown.swapped.frames[rows]
        columns = [windows.frames[rows, 0], own, swapped, change_map(own, swapped)]
        names = ["frame", "own latents", "others'", "difference"]
        if shown.region is not None:
            where = np.where(shown.region[rows][..., None], own, (own * 0.15).astype(np.uint8))
            columns, names = [*columns, where], [*names, "moving slots"]
        alt = (
            "Rows are windows: frame, imagined under its own latents and under another window's, the difference, and "
            "where the slots that move are."
        )
        caption = (
            f"What exchanging the latents changes after {steps} steps: orange where the others make it brighter, blue "
            "where darker."
        )
        blocks.append(_grid("sensitivity", columns, labels, names, alt, caption))
    if shown.held is not None:
        columns = []
        for place, window in enumerate((0, len(shown.start.frames) - 1)):
            before = np.broadcast_to(shown.start.frames[window], shown.held[:, place].shape)
            columns += [before, shown.held[:, place], change_map(before, shown.held[:, place])]
        names = ["first place", f"t = {steps}", "change", "last place", f"t = {steps}", "change"]
        alt = (
            "Rows are prototypes: a frame, the frame imagined while the prototype is held, the change; from two places."
        )
        caption = f"Each prototype in use, held for {steps} steps from two held-out frames."
        blocks.append(_grid("held", columns, [f"code {code}" for code in shown.codes], names, alt, caption))
    return blocks


def _grid(name: str, columns: list[Any], rows: list[str], names: list[str], alt: str, caption: str) -> Picture:
    return Picture(name, png(image_grid(np.stack(columns, 1), rows, names)), alt, caption)


def _prototype_table(table: Sequence[Mapping[str, Any]]) -> list[Block]:
    rows = []
    for row in table:
        moved = f"{row['pixels'][0]:+.1f} right, {row['pixels'][1]:+.1f} down"
        rows.append([f"code {row['code']}", f"slot {row['slot'] + 1}", moved, f"{row['spread']:.1f}"])
    caption = "The slot that a held prototype moves most on average, how far (pixels), and how far places differ."
    headers = ["prototype", "moves most", "mean displacement", "standard deviation"]
    return [Table(headers, rows, caption)] if rows else []


def _usage(counts: Sequence[int]) -> list[Block]:
    alt, caption = f"Share of transitions by code: {', '.join(map(str, counts))}.", "Codes of the held-out episodes."
    return [chart("codebook", lambda theme: usage_chart(counts, theme), alt, caption)] if counts else []


def _code_table(table: Sequence[Mapping[str, Any]]) -> list[Block]:
    chosen = [one for one in table if one["mean"] is not None]
    rows = [
        [f"code {one['code']}", str(one["count"])]
        + [f"{m:+.2f} ± {s:.2f}" for m, s in zip(one["mean"], one["std"], strict=True)]
        for one in chosen
    ]
    headers = ["prototype", "transitions", *(f"action {n + 1}" for n in range(len(rows[0]) - 2 if rows else 0))]
    caption = "Real actions by prototype, scaled as they are learned: mean ± standard deviation."
    return [Table(headers, rows, caption)] if rows else []


def _probe_table(probes: Mapping[str, Any]) -> list[Block]:
    if "latent" not in probes:
        return []
    kinds = {"linear": "linear", "mlp": "two-layer network"}
    r2 = {said: probes["latent"][kind]["r2"] for kind, said in kinds.items()}
    rows = [[said, *map(_rounded, values)] for said, values in r2.items()]
    headers = ["probe", *(f"action {n + 1}" for n in range(len(rows[0]) - 1))]
    return [Table(headers, rows, "R² of each number of the action; – where it hardly varies.")]


def _slot_table(slots: Sequence[Mapping[str, Any]]) -> list[Block]:
    rows = [[f"slot {one['slot']}", f"{one['change']:.0%}", f"{one['r2'] + 0.0:.2f}"] for one in slots]
    caption = "How much of the slots' change is each one's, and what that alone tells of the action."
    return [Table(["slot", "share of the change", "R² of the action"], rows, caption)] if rows else []


def _videos(given: ReportInput) -> str:
    """A data set to inspect on: of the run's own the demonstrations first, else what its config names."""
    own = [f"{given.shown}/data/{path.parts[-3]}" for path in sorted(given.run.glob("data/*/meta/info.json"))]
    return next(filter(None, [*own, given.config.data.demos, given.config.data.root]), "SET")


def card_section(given: ReportInput) -> Section:
    """The stored card; a note where there is none, or that of another world model."""
    title, result = "Report card", json_or_nothing(given.run / RESULT)
    command = given.command("inspect", f"data.root={_videos(given)}")
    if not result:
        return Section(title, [Missing("There is no report card of the world model yet.", command)])
    prints = {stage: given.metas.get(stage, {}).get("fingerprint") for stage in ("slots", "dynamics")}
    if result["fingerprints"] != prints:
        return Section(title, [Missing("The report card is that of another world model.", command)])
    blocks: list[Block] = [Text(f"{verdict_text(result)}. {told_text(result)}")]
    for group, table, beside in _groups(result):
        blocks += [Table([group, *table.headers[1:]], table.rows), *beside]
    return Section(title, [*blocks, Text("With pictures: `inspect/inspect.html`.")])
