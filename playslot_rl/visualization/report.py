"""`report.md` and `report.html` of a run."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import ExperimentConfig, from_dict
from playslot_rl.envs import PROCEDURAL
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.storage.atomic import write_bytes, write_text
from playslot_rl.storage.checkpoints import checkpoint_folder
from playslot_rl.training.runs import world_model_folder
from playslot_rl.visualization.document import Block, Document, Picture, Section, Table, Text
from playslot_rl.visualization.html import to_html
from playslot_rl.visualization.latents import latent_section
from playslot_rl.visualization.markdown import to_markdown
from playslot_rl.visualization.rollouts import expert_frames
from playslot_rl.visualization.sections import (
    STAGES,
    ReportInput,
    machine_row,
    model_rows,
    prototype_section,
    read_evaluations,
    rollout_section,
    seconds,
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
        run: run folder.
        config: of the run; None reads `RUN/config.json`.
        agent: trained agent; None where there is no policy yet.
        world_model: trained world model; None means the agent's.
        pool: environments to use and leave open; None makes and closes its own.

    Returns:
        Path of `report.html`.

    Raises:
        ConfigError: no config was given and the run has none, or it is not one of this version.
        OutputError: a file cannot be written.
    """
    config = config or stored_config(run)
    if config.env.name in PROCEDURAL:
        from playslot_rl.visualization.object_report import build as build_objects

        model = world_model.eval() if world_model is not None else None
        return save(run, build_objects(run, config, model, shown_path(run), read_metas(run)))
    own = TaskPool(config.env, config.render) if pool is None else None
    used = pool or own
    assert used is not None
    model = world_model or (agent.world_model if agent is not None else None)
    for module in (model, agent):
        if module is not None:
            module.eval()
    given = ReportInput(run, config, model, agent, used, shown_path(run), read_metas(run))
    try:
        document = build(given)
    finally:
        if own is not None:
            own.close()
    return save(run, document)


def save(run: Path, document: Document) -> Path:
    """Write a report and its figures into a run folder; returns the path of the HTML file.

    Raises:
        OutputError: a file cannot be written.
    """
    figures = run / "figures"
    figures.mkdir(parents=True, exist_ok=True)
    for section in document.sections:
        for block in section.blocks:
            if isinstance(block, Picture):
                write_bytes(figures / f"{block.name}.png", block.light)
    write_text(run / "report.md", to_markdown(document))
    write_text(run / "report.html", to_html(document))
    return run / "report.html"


def stored_config(run: Path) -> ExperimentConfig:
    """`RUN/config.json`.

    Raises:
        ConfigError: it is missing or not one of this version.
    """
    path = run / "config.json"
    try:
        return from_dict(ExperimentConfig, json.loads(path.read_text()))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path} cannot be used: {error}; expected the config of a run; check run=") from error


def read_metas(run: Path) -> dict[str, dict[str, Any]]:
    """Stage -> meta of its finished checkpoint; for the world model's stages, of the model that the run uses."""
    try:
        model = world_model_folder(run)
    except CheckpointError:
        model = run  # the report is written from what there is
    homes = {"slots": model, "dynamics": model, "policy": run}
    paths = {stage: checkpoint_folder(homes[stage], stage) / "meta.json" for stage in STAGES}
    return {stage: json.loads(path.read_text()) for stage, path in paths.items() if path.is_file()}


def shown_path(run: Path) -> str:
    """The run folder relative to the working directory; only its name where it lies elsewhere."""
    relative = os.path.relpath(run)
    return relative if not relative.startswith("..") else run.name


def build(given: ReportInput) -> Document:
    """All sections, success first."""
    clips: list[Any] = []

    def clip() -> Any:
        if not clips:
            clips.append(expert_frames(given.pool, given.first_seed))
        frames: np.ndarray[Any, Any] = clips[0]
        return frames

    sections = [
        success_section(given),
        rollout_section(given),
        slots_section(given, clip),
        prototype_section(given, clip),
        latent_section(given),
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
    config, model = given.config, given.world_model
    env = config.env
    rows = [
        ["frames", f"{env.image_size} x {env.image_size} pixels, rendering `{config.render.quality}`"],
        ["agent step", f"{env.frame_skip} environment steps; at most {env.max_steps} agent steps an episode"],
        ["warm-up", f"{env.warmup_steps} random agent steps after each reset"],
    ]
    rows += model_rows(model)
    if model is not None:
        sizes = {
            name: sum(p.numel() for p in module.parameters()) for name, module in _parts(model, given.agent).items()
        }
        rows.append(["parameters", ", ".join(f"{name} {size:,}" for name, size in sizes.items())])
    for protocol, result in read_evaluations(given.run).items():
        seeds = result["seeds"]
        what = f"{len(seeds)} seeds from {min(seeds)} to {max(seeds)}, {seconds(result.get('wall_seconds'))}"
        rows.append([f"evaluation, {protocol}", f"{what}, {result.get('redrawn', 0)} redrawn"])
    rows.append(machine_row())
    blocks: list[Block] = [Table(["setting", "value"], rows), *(Text(note) for note in notes(given))]
    return Section("Settings and notes", blocks)


def _parts(model: WorldModel, agent: Agent | None) -> dict[str, Any]:
    parts: dict[str, Any] = {"SAVi": model.savi, "InvDyn": model.inverse_dynamics, "cOCVP": model.predictor}
    if agent is not None:
        parts |= {"policy": agent.policy, "action decoder": agent.action_decoder}
    return parts


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
