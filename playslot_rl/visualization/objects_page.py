"""The report of a run on videos whose objects and moves are known (GridShapes): no policy, but ARI and probes."""

from __future__ import annotations

from typing import Any

import numpy as np

from playslot_rl.envs.grid_shapes import generate
from playslot_rl.evaluation.objects import RESULT, parse_clips, seed_frames
from playslot_rl.evaluation.seeds import first_seed
from playslot_rl.frames import to_uint8
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.visualization.card_page import card_section
from playslot_rl.visualization.document import Block, Document, Missing, Picture, Section, Table, Text
from playslot_rl.visualization.grid import film_strip, png
from playslot_rl.visualization.sections import (
    ReportInput,
    percent,
    prototype_section,
    seconds,
    settings_table,
    slots_section,
    training_section,
)

CLIPS_SHOWN = 3
PROBES = {"prototype": "from the slot's prototype", "latent": "from the slot's latent action (mean)"}


def build_objects(given: ReportInput) -> Document:
    """All sections of the report on known objects; what is missing is named with its command."""
    config, grid = given.config, given.config.env.grid
    result = json_or_nothing(given.run / RESULT) or None
    seed = first_seed(config, config.seed) if result is None else int(result["seeds"][0])
    clips = generate(range(seed, seed + CLIPS_SHOWN), config.env.max_steps, config.env)
    sections = [
        scores_section(given, result),
        prediction_section(given, clips.frames, result),
        slots_section(given, lambda: clips.frames[0], "The first evaluated clip."),
        prototype_section(given, lambda: clips.frames[0]),
        code_section(result),
        card_section(given),
        training_section(given, ("slots", "dynamics")),
        object_settings(given, result),
    ]
    lead = (
        f"`{config.env.name}` with {grid.objects} objects, preset `{config.preset}`, seed {config.seed}. A PlaySlot "
        "world model learned from videos alone; where the objects are and what they did is known, and only scores it."
    )
    return Document(f"PlaySlot report: {given.run.resolve().name}", lead, sections)


def scores_section(given: ReportInput, result: dict[str, Any] | None) -> Section:
    """ARI and probes."""
    title = "Objects and moves"
    if result is None:
        return Section(title, [Missing("Nothing has been scored yet.", given.command("evaluate"))])
    ari = [
        ["all pixels", f"{result['ari']:.3f}"],
        ["pixels of objects (FG-ARI)", f"{result['foreground_ari']:.3f}"],
    ]
    caption = (
        f"Slot masks against the true masks, {result['episodes']} held-out clips scored as wholes; 1 is perfect, 0 is "
        "chance. Each pixel belongs to the slot with the largest mask."
    )
    probes = [
        [label, percent(p["accuracy"]), percent(p["majority"]), percent(p["chance"]), str(p["test"])]
        for name, label in PROBES.items()
        if (p := result["probes"].get(name)) is not None
    ]
    headers = ["move of an object, read", "accuracy", "most frequent move", "chance", "moves tested"]
    note = "Logistic regression, fitted and tested on different clips. A slot belongs to the object it overlaps most."
    blocks: list[Block] = [Table(["adjusted Rand index", "mean"], ari, caption), Table(headers, probes, note)]
    if result["unmatched"]:
        blocks.append(
            Text(f"{result['unmatched']} objects got no slot: there are fewer slots than objects and ground.")
        )
    return Section(title, blocks)


def prediction_section(given: ReportInput, frames: Any, result: dict[str, Any] | None) -> Section:
    """Predicted beside true frames."""
    title = "Prediction"
    if given.world_model is None:
        return Section(title, [Missing("There is no trained dynamics model.", given.command("train-dynamics"))])
    parsed = parse_clips(given.world_model, frames)
    predicted, seed = to_uint8(parsed.predicted), seed_frames(given.config.env.max_steps)
    pairs = np.stack([frames[:, seed : seed + predicted.shape[1]], predicted], 1)
    labels = [f"{c + 1} {name}" for c in range(len(frames)) for name in ("true", "predicted")]
    drawn = film_strip(pairs.reshape(-1, *pairs.shape[2:]), labels, first=seed)
    blocks: list[Block] = []
    if result is not None:
        ahead = result["prediction"]
        blocks.append(
            Text(
                f"{ahead['predicted_frames']} frames predicted from {ahead['seed_frames']} seen ones, under the latent "
                f"actions inferred from the true video: PSNR {ahead['psnr']:.1f} dB, SSIM {ahead['ssim']:.3f}; "
                f"reconstruction {result['reconstruction']['psnr']:.1f} dB. The paper (two objects): 54.1 dB and 0.996."
            )
        )
    alt = "Two rows a clip: true frames and the predictions for the same times."
    return Section(title, [*blocks, Picture("prediction", png(drawn), alt, "The first evaluated clips, not chosen.")])


def code_section(result: dict[str, Any] | None) -> Section:
    """What the objects did, by prototype."""
    title = "Prototypes and moves"
    if result is None or result["codes"] is None:
        return Section(title, [Text("No prototypes have been scored.")])
    rows = []
    for code, counts in enumerate(result["codes"]):
        total = sum(counts)
        rows.append([f"code {code}", str(total), *(percent(n / total if total else None) for n in counts)])
    caption = "Transitions of objects whose slot has this prototype, and what the object did."
    return Section(title, [Table(["", "transitions", *result["moves"]], rows, caption)])


def object_settings(given: ReportInput, result: dict[str, Any] | None) -> Section:
    """Settings and sizes."""
    env, grid = given.config.env, given.config.env.grid
    task = [
        ["frames", f"{env.image_size} x {env.image_size} pixels, drawn from seeds"],
        ["objects", f"{grid.objects} of {grid.size} pixels, {grid.speed} pixels a step"],
        ["new direction", f"with probability {grid.change} at each step"],
    ]
    measured = []
    if result is not None:
        seeds, took = result["seeds"], seconds(result.get("wall_seconds"))
        measured.append(["scored", f"{len(seeds)} clips, seeds {min(seeds)} to {max(seeds)}, {took}"])
    return Section("Settings", [settings_table(given.world_model, task, measured)])
