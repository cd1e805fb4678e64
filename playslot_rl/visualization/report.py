"""`report.md` and `report.html` of a run."""

from __future__ import annotations

import os
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from typing import Any

from playslot_rl.acting.actor import ExpertActor
from playslot_rl.acting.episodes import TaskPool, record
from playslot_rl.config import ExperimentConfig
from playslot_rl.envs import PROCEDURAL
from playslot_rl.errors import CheckpointError
from playslot_rl.runs import Run
from playslot_rl.storage.atomic import json_or_nothing
from playslot_rl.storage.checkpoints import checkpoint_folder
from playslot_rl.visualization.card_page import card_section
from playslot_rl.visualization.document import (
    Document,
    Section,
    Text,
    write_document,
)
from playslot_rl.visualization.latents import latent_section
from playslot_rl.visualization.objects_page import build_objects
from playslot_rl.visualization.sections import (
    STAGES,
    ReportInput,
    percent,
    prototype_section,
    read_evaluations,
    rollout_section,
    seconds,
    settings_table,
    slots_section,
    success_section,
    training_section,
)
from playslot_rl.world_model import Agent, WorldModel


def write_report(
    run: Path,
    config: ExperimentConfig | None = None,
    *,
    agent: Agent | None = None,
    world_model: WorldModel | None = None,
    pool: TaskPool | None = None,
) -> Path:
    """Write `RUN/report.md`, `RUN/report.html` and `RUN/figures/*.png` from what the run has so far.

    Args:
        run: its folder.
        config: None reads `RUN/config.json`.
        agent: None where there is no policy yet.
        world_model: None means the agent's.
        pool: environments to use and leave open; None makes and closes its own.

    Returns:
        Path of `report.html`.

    Raises:
        ConfigError: no config was given and the run has none, or it is not one of this version.
        OutputError: a file cannot be written.
    """
    config = config or Run(run).config
    model = world_model or (agent.world_model if agent is not None else None)
    for module in (model, agent):
        if module is not None:
            module.eval()
    with TaskPool(config.env, config.render) if pool is None else nullcontext(pool) as used:
        relative = os.path.relpath(run)
        shown = relative if not relative.startswith("..") else run.name
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
    found = {stage: json_or_nothing(checkpoint_folder(homes[stage], stage) / "meta.json") for stage in STAGES}
    return {stage: meta for stage, meta in found.items() if meta}


def build(given: ReportInput) -> Document:
    """All sections, success first."""

    @cache
    def clip() -> Any:
        return record(given.pool, ExpertActor(), [given.first_seed])[0][0]

    sections = [
        success_section(given),
        rollout_section(given),
        slots_section(given, clip),
        prototype_section(given, clip),
        latent_section(given),
        card_section(given),
        training_section(given),
        settings_section(given),
    ]
    env = given.config.env
    lead = (
        f"Task `{env.name}`, preset `{given.config.preset}`, seed {given.config.seed}. A policy "
        f"learned from unlabelled videos through a PlaySlot world model{labels_used(given)}."
    )
    return Document(f"PlaySlot report: {given.run.resolve().name}", lead, sections)


def labels_used(given: ReportInput) -> str:
    """Clause on demonstrations and labels, from the policy's meta file."""
    meta = given.metas.get("policy", {})
    demos, labelled = meta.get("demos"), meta.get("labelled_demos")
    if demos is None or labelled is None:
        return ""
    return f": {demos} demonstration videos, the real actions of {labelled} of them"


def settings_section(given: ReportInput) -> Section:
    """Settings, sizes and what a reader should know before quoting a number."""
    env, model = given.config.env, given.world_model
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
        sizes = {name: sum(p.numel() for p in part.parameters()) for name, part in parts.items()}
        measured.append(["parameters", ", ".join(f"{name} {size:,}" for name, size in sizes.items())])
    for protocol, result in read_evaluations(given.run).items():
        seeds = result["seeds"]
        what = f"{len(seeds)} seeds from {min(seeds)} to {max(seeds)}, {seconds(result.get('wall_seconds'))}"
        measured.append([f"evaluation, {protocol}", f"{what}, {result.get('redrawn', 0)} redrawn"])
    return Section(
        "Settings and notes", [settings_table(model, task, measured), *(Text(note) for note in notes(given))]
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
    results = read_evaluations(given.run)
    found.append(
        "No evaluation seed is in a data set whose seeds are on record. An episode that starts solved is replaced by "
        "another seed and counted. The references of both protocols run closed-loop."
        if results
        else "Nothing has been evaluated yet."
    )
    seeds = {r.get("seed") for r in results.values()}
    if len(seeds) == 1:
        found.append("One training seed: the intervals cover the choice of episodes, not that of the training run.")
    return found
