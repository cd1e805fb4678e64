"""`report.md` and `report.html` of a run."""

from __future__ import annotations

import os
from contextlib import nullcontext, suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.acting.actor import ExpertActor
from playslot_rl.acting.episodes import TaskPool, record
from playslot_rl.config import EnvConfig, ExperimentConfig, from_dict
from playslot_rl.envs import PROCEDURAL
from playslot_rl.envs.grid_shapes import generate
from playslot_rl.errors import CheckpointError
from playslot_rl.evaluation.held_out import first_seed
from playslot_rl.evaluation.objects import RESULT, parse_clips, seed_frames
from playslot_rl.frames import png, to_uint8
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.storage.checkpoints import checkpoint_folder
from playslot_rl.visualization import sections as part
from playslot_rl.visualization.card_page import card_section
from playslot_rl.visualization.document import Block, Document, Missing, Picture, Section, Table, Text, write_document
from playslot_rl.visualization.grid import film_strip
from playslot_rl.visualization.sections import ReportInput, percent, seconds
from playslot_rl.world_model import Agent, WorldModel


def write_report(
    run: Path,
    config: ExperimentConfig | None = None,
    *,
    agent: Agent | None = None,
    world_model: WorldModel | None = None,
    pool: TaskPool | None = None,
) -> Path:
    """Write `RUN/report.md`, `RUN/report.html` and `RUN/figures/*.png` from what the run has so far; returns the path
    of the HTML.

    Args:
        config: None reads `RUN/config.json`; a ConfigError where there is none, or not one of this version.
        world_model: None means the agent's.
        pool: environments to use and leave open; None makes and closes its own.
    """
    config = config or Run(run).config
    model = world_model or (agent.world_model if agent is not None else None)
    for module in (model, agent):
        if module is not None:
            module.eval()
    with TaskPool(config.acting, config.render) if pool is None else nullcontext(pool) as used:
        relative = os.path.relpath(run)
        shown = relative if not relative.startswith("..") else run.name  # a report names no folder of this machine
        given = ReportInput(run, config, model, agent, used, shown, read_metas(run))
        document = build_objects(given) if config.env.name in PROCEDURAL else build(given)
    return write_document(document, run, "report")


def read_metas(run: Path) -> dict[str, dict[str, Any]]:
    """Stage -> meta of its finished checkpoint; for the world model's stages, of the model that the run uses."""
    try:
        model = Run.open(run).world_run.folder
    except CheckpointError:
        model = run  # the report is written from what there is
    homes = {"slots": model, "dynamics": model, "policy": run}
    found = {stage: json_or_nothing(checkpoint_folder(homes[stage], stage) / "meta.json") for stage in part.STAGES}
    return {stage: meta for stage, meta in found.items() if meta}


def build(given: ReportInput) -> Document:
    @cache
    def clip() -> Any:
        return record(given.pool, ExpertActor(), [given.first_seed])[0][0]

    sections = [
        part.success_section(given),
        part.rollout_section(given),
        part.slots_section(given, clip),
        part.prototype_section(given, clip),
        card_section(given),
        part.training_section(given),
        settings_section(given),
    ]
    meta, used = given.metas.get("policy", {}), ""
    if meta.get("demos") is not None and meta.get("labelled_demos") is not None:
        used = f": {meta['demos']} demonstration videos, the real actions of {meta['labelled_demos']} of them"
    lead = (
        f"Task `{given.config.env.full_name}`, preset `{given.config.preset}`, seed {given.config.seed}. A policy "
        f"learned from unlabelled videos through a PlaySlot world model{used}."
    )
    return Document(f"PlaySlot report: {given.run.resolve().name}", lead, sections)


def settings_section(given: ReportInput) -> Section:
    env, model = given.config.acting, given.world_model
    task = [
        ["frames", f"{env.image_size} x {env.image_size} pixels, rendering `{given.config.render.quality}`"],
        ["agent step", f"{env.frame_skip} environment steps; at most {env.max_steps} agent steps an episode"],
        ["warm-up", f"{env.warmup_steps} random agent steps after each reset"],
    ]
    measured = []
    if model is not None:
        parts: dict[str, Any] = {"SAVi": model.savi, "InvDyn": model.inverse_dynamics, "cOCVP": model.predictor}
        if given.agent is not None:
            parts |= {"policy": given.agent.policy, "action decoder": given.agent.action_decoder}
        sizes = {name: sum(p.numel() for p in module.parameters()) for name, module in parts.items()}
        measured.append(["parameters", ", ".join(f"{name} {size:,}" for name, size in sizes.items())])
    for protocol, result in given.evaluations.items():
        seeds = result["seeds"]
        what = f"{len(seeds)} seeds from {min(seeds)} to {max(seeds)}, {seconds(result.get('wall_seconds'))}"
        drawn = result.get("render", {}).get("quality", given.config.render.quality)
        how = f"at most {given.steps(result)} agent steps, rendering `{drawn}`"
        with suppress(ValueError, KeyError):  # of an earlier version
            seen = from_dict(EnvConfig, result["env"]).seen
            how += f", **seen with {seen}**" if seen != given.config.env.seen else ""
        measured.append([f"evaluation, {protocol}", f"{what}, {result.get('redrawn', 0)} redrawn, {how}"])
    return Section(
        "Settings and notes", [part.settings_table(model, task, measured), *(Text(note) for note in notes(given))]
    )


def notes(given: ReportInput) -> list[str]:
    """Sentences that keep the numbers honest."""
    found = []
    meta = given.metas.get("policy", {})
    model = given.world_model
    mode = model.config.inverse_dynamics.mode if model is not None else given.config.model.inverse_dynamics.mode
    unlabelled = "" if mode == "ground_truth" else "; world model and latent policy saw none"
    if meta.get("labelled_demos") is not None:
        found.append(
            f"Labels: the action decoder saw the real actions of {meta['labelled_demos']} of {meta.get('demos')} "
            f"demonstrations{unlabelled}. The slot oracle is the policy's network trained "
            "on the real actions of all demonstrations: it shows what the slots allow."
        )
    if meta.get("kept_rows", 1.0) < 1.0:
        found.append(
            f"Still stretches left out: {percent(meta['kept_rows'])} of the demonstrations' rows were learned from, "
            "those in which the slots move and a few after them (`behaviour.trim`); no action was looked at."
        )
    found.append(
        "No evaluation seed is in a data set whose seeds are on record. An episode that starts solved is replaced by "
        "another seed and counted. The references of both protocols run closed-loop."
        if given.evaluations
        else "Nothing has been evaluated yet."
    )
    if given.evaluations:
        found.append("One training seed: the intervals cover the choice of episodes, not that of the training run.")
    return found


CLIPS_SHOWN = 3
PROBES = {"prototype": "from the slot's prototype", "latent": "from the slot's latent action (mean)"}


def build_objects(given: ReportInput) -> Document:
    """All sections of the report on known objects; what is missing is named with its command."""
    config, grid = given.config, given.config.env.grid
    result = given.measured(RESULT)
    seed = first_seed(config, config.seed) if result is None else int(result["seeds"][0])
    clips = generate(range(seed, seed + CLIPS_SHOWN), config.env.max_steps, config.env)
    sections = [
        scores_section(given, result),
        prediction_section(given, clips.frames, result),
        part.slots_section(given, lambda: clips.frames[0], "The first evaluated clip."),
        part.prototype_section(given, lambda: clips.frames[0]),
        code_section(result),
        card_section(given),
        part.training_section(given, ("slots", "dynamics")),
        object_settings(given, result),
    ]
    lead = (
        f"`{config.env.name}` with {grid.objects} objects, preset `{config.preset}`, seed {config.seed}. A PlaySlot "
        "world model learned from videos alone; where the objects are and what they did is known, and only scores it."
    )
    return Document(f"PlaySlot report: {given.run.resolve().name}", lead, sections)


def scores_section(given: ReportInput, result: dict[str, Any] | None) -> Section:
    title = "Objects and moves"
    if result is None:
        return Section(title, [Missing("Nothing has been scored yet.", given.command("evaluate"))])
    ari = [["all pixels", f"{result['ari']:.3f}"], ["pixels of objects (FG-ARI)", f"{result['foreground_ari']:.3f}"]]
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
    return Section("Settings", [part.settings_table(given.world_model, task, measured)])
