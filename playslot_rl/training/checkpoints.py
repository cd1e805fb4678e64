"""Finished stages: `weights.safetensors`, `config.json` and `meta.json` in a folder. Never a pickle.

The layout of a run (`RUN`), and of the shipped models, is the same:

    RUN/slots/checkpoint       module `savi`
    RUN/dynamics/checkpoint    modules `inverse_dynamics`, `predictor`; parent: slots
    RUN/policy/checkpoint      modules `policy`, `action_decoder`, `oracle` (if trained); parents: slots, dynamics
    RUN/METHOD/checkpoint      a baseline; parents: slots, where it builds on them

A run whose world model lives elsewhere has `RUN/world_model.json`, `{"source": "pretrained"}` or a path relative to
RUN. A child names its parents by the fingerprints of their weights and refuses any other.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from playslot_rl.config import EnvConfig, ModelConfig, from_dict
from playslot_rl.errors import CheckpointError
from playslot_rl.training.atomic import explain_write_errors, replace_dir, temporary_name, write_bytes, write_json
from playslot_rl.training.provenance import provenance
from playslot_rl.training.resume import first_difference
from playslot_rl.training.tensors import (
    load_modules,
    load_tensors,
    module_tensors,
    save_tensors,
    weights_fingerprint,
)

if TYPE_CHECKING:
    from playslot_rl.modules.savi import SAVi
    from playslot_rl.world_model import Agent, WorldModel

FORMAT = "playslot_rl.checkpoint/1"
PRETRAINED = "pretrained"
STAGES = ("slots", "dynamics", "policy")
_COMMANDS = {
    "slots": "train-slots",
    "dynamics": "train-dynamics",
    "policy": "train-policy",
    "lapo_model": "train-baseline method=lapo",
}


def training_command(stage: str) -> str:
    """The command that trains a stage, or a baseline of that name."""
    return _COMMANDS.get(stage, f"train-baseline method={stage}")


@dataclass(frozen=True)
class StageCheckpoint:
    """A finished stage on disk.

    Attributes:
        path: its folder.
        stage: `slots`, `dynamics` or `policy`.
        config: `{"env": ..., "model": ..., STAGE: ...}`, the plain values it was trained with.
        meta: how it was made: commit, data, parents, metrics, steps, seconds, command.
        fingerprint: first 16 hex digits of the SHA-256 of its weights.
    """

    path: Path
    stage: str
    config: dict[str, Any]
    meta: dict[str, Any]
    fingerprint: str


def checkpoint_folder(run: Path, stage: str) -> Path:
    """`RUN/STAGE/checkpoint`."""
    return run / stage / "checkpoint"


def save_stage(
    path: Path,
    *,
    stage: str,
    modules: Mapping[str, nn.Module],
    config: Mapping[str, Any],
    data: Mapping[str, str],
    parents: Mapping[str, str],
    metrics: Mapping[str, float],
    steps: int,
    seconds: float,
    extra: Mapping[str, Any] | None = None,
) -> StageCheckpoint:
    """Write a finished stage, atomically.

    Args:
        path: the folder to make (`checkpoint_folder(run, stage)`); replaced if it exists.
        stage: `slots`, `dynamics` or `policy`.
        modules: what to store, by name.
        config: `{"env": ..., "model": ..., STAGE: ...}`, plain values.
        data: fingerprints of the data sets, by role (`train`, `demos`).
        parents: fingerprints of the parents' weights, by stage.
        metrics: final numbers.
        steps: optimiser steps.
        seconds: wall-clock seconds of training.
        extra: more plain values for `meta.json` (`labelled_demos`, `demos`).

    Raises:
        OutputError: full disk, or a folder that cannot be written.
    """
    temporary = temporary_name(path)
    with explain_write_errors(path):
        _remove_leftovers(path)
        temporary.mkdir(parents=True)
        try:
            save_tensors(temporary / "weights.safetensors", module_tensors(modules))
            fingerprint = weights_fingerprint(temporary / "weights.safetensors")
            meta = {
                "format": FORMAT,
                "stage": stage,
                "fingerprint": fingerprint,
                "modules": sorted(modules),
                "data": dict(data),
                "parents": dict(parents),
                "metrics": dict(metrics),
                "steps": steps,
                "seconds": round(seconds, 1),
                **provenance(),
                **(extra or {}),
            }
            write_json(temporary / "config.json", dict(config))
            write_json(temporary / "meta.json", meta)
            replace_dir(temporary, path)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    return StageCheckpoint(path, stage, dict(config), meta, fingerprint)


def _remove_leftovers(path: Path) -> None:
    """Remove what a process killed while it wrote this checkpoint has left."""
    for leftover in path.parent.glob(f".{path.name}.tmp-*"):
        shutil.rmtree(leftover)


def read_stage(path: Path, stage: str) -> StageCheckpoint:
    """Read config and meta of a finished stage and check that its weights are the ones that were saved.

    Raises:
        CheckpointError: no checkpoint there, another stage or format, or a damaged file.
    """
    if not (path / "meta.json").is_file():
        raise CheckpointError(
            f"no {stage} checkpoint at {path}, expected meta.json, config.json and weights.safetensors: "
            f"run `playslot {training_command(stage)}` first, or check run="
        )
    meta, config = _read_json(path / "meta.json"), _read_json(path / "config.json")
    if meta.get("format") != FORMAT:
        raise CheckpointError(
            f"{path}: got format {meta.get('format')!r}, expected {FORMAT!r}: "
            "use the version of playslot_rl that wrote it"
        )
    if meta.get("stage") != stage:
        raise CheckpointError(
            f"{path}: got a checkpoint of stage {meta.get('stage')!r}, expected {stage!r}: check run="
        )
    weights = path / "weights.safetensors"
    if not weights.is_file():
        raise CheckpointError(f"{weights} is missing, expected the stage's weights: train {stage} again")
    return StageCheckpoint(path, stage, config, meta, weights_fingerprint(weights))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise CheckpointError(f"{path} is damaged ({error}), expected a JSON object: train that stage again") from error
    if not isinstance(values, dict):
        raise CheckpointError(f"{path}: got {type(values).__name__}, expected a JSON object: train that stage again")
    return values


def load_weights(checkpoint: StageCheckpoint, modules: Mapping[str, nn.Module]) -> None:
    """Load a finished stage into freshly built modules, in place.

    Raises:
        CheckpointError: missing, unexpected or misshapen tensors, or a file that is not the one that was saved.
    """
    load_modules(modules, load_tensors(checkpoint.path / "weights.safetensors"), str(checkpoint.path))
    require_whole(checkpoint)


def require_whole(checkpoint: StageCheckpoint) -> None:
    """Check that the weights are the ones that were saved.

    Raises:
        CheckpointError: they are not.
    """
    saved = checkpoint.meta.get("fingerprint")
    if checkpoint.fingerprint != saved:
        raise CheckpointError(
            f"{checkpoint.path / 'weights.safetensors'}: got fingerprint {checkpoint.fingerprint}, expected {saved} "
            f"from its meta.json: the file was changed or damaged; put it back, or train {checkpoint.stage} again"
        )


def require_parents(child: StageCheckpoint, parents: Mapping[str, StageCheckpoint]) -> None:
    """Check that a child was trained on exactly these parents.

    Raises:
        CheckpointError: a parent is another one, or damaged.
    """
    for name, parent in parents.items():
        require_whole(parent)
        expected = child.meta.get("parents", {}).get(name)
        if parent.fingerprint != expected:
            raise CheckpointError(
                f"{child.path} was trained on {name} {expected}, got {name} {parent.fingerprint} at {parent.path}: "
                f"run `playslot {training_command(child.stage)}` again on these, or put its parent back"
            )


def require_config(checkpoint: StageCheckpoint, wanted: Mapping[str, Any]) -> None:
    """Check that the parts of a config in `wanted`, such as `{"model": {"savi": ...}}`, are those of a checkpoint.

    Raises:
        CheckpointError: names the first key that differs.
    """
    difference = first_difference(_restrict(checkpoint.config, wanted), wanted)
    if difference is not None:
        key, old, new = difference
        raise CheckpointError(
            f"{key}: got {new}, expected {old}, with which {checkpoint.path} was trained: "
            f"leave {key} as it was, or use another out="
        )


def _restrict(values: Any, pattern: Mapping[str, Any]) -> dict[str, Any]:
    return {
        key: _restrict(values[key], part)
        if isinstance(part, Mapping) and isinstance(values[key], Mapping)
        else values[key]
        for key, part in pattern.items()
        if isinstance(values, Mapping) and key in values
    }


# --- runs ---------------------------------------------------------------------------------------------------------


def pretrained_folder(env: str = "button_press") -> Path:
    """The shipped world model of an environment, a folder laid out like a run.

    Raises:
        CheckpointError: no model ships for it.
    """
    import importlib.resources

    root = Path(str(importlib.resources.files("playslot_rl.pretrained")))
    names = sorted(path.parents[2].name for path in root.glob("*/dynamics/checkpoint/meta.json"))
    if env not in names:
        shipped = ", ".join(names) or "none"
        raise CheckpointError(
            f"no pretrained world model for env={env}, expected one of: {shipped}; train one by `playslot pipeline`"
        )
    return root / env


def run_folder(run: Path | str, env: str = "button_press") -> Path:
    """`pretrained` or a path to the folder that it names.

    Raises:
        CheckpointError: there is no such folder.
    """
    if str(run) == PRETRAINED:
        return pretrained_folder(env)
    folder = Path(run)
    if not str(run) or not folder.is_dir():
        raise CheckpointError(f"run={run}: no such folder, expected a run folder or `{PRETRAINED}`: check run=")
    return folder


def adopt_stage(checkpoint: StageCheckpoint, run: Path) -> None:
    """Copy a finished parent stage into the run that builds on it, so that the run is whole.

    Raises:
        CheckpointError: the run has another checkpoint of that stage.
        OutputError: full disk.
    """
    target = checkpoint_folder(run, checkpoint.stage)
    require_adoptable(checkpoint, run)
    if target.exists():
        return
    temporary = temporary_name(target)
    with explain_write_errors(target):
        _remove_leftovers(target)
        try:
            temporary.mkdir(parents=True)
            for file in sorted(checkpoint.path.iterdir()):
                write_bytes(temporary / file.name, file.read_bytes())
            replace_dir(temporary, target)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


def require_adoptable(checkpoint: StageCheckpoint, run: Path) -> None:
    """Check that a run has no checkpoint of that stage, or this one.

    Raises:
        CheckpointError: it has another one.
    """
    target = checkpoint_folder(run, checkpoint.stage)
    if not (target / "meta.json").is_file():
        return
    own = read_stage(target, checkpoint.stage)
    if own.fingerprint != checkpoint.fingerprint:
        raise CheckpointError(
            f"{run} has {checkpoint.stage} {own.fingerprint} of its own, got {checkpoint.stage} "
            f"{checkpoint.fingerprint} from {checkpoint.path}: leave run= out to build on its own, or use another out="
        )


def link_world_model(run: Path, source: Path | str) -> None:
    """Say that the world model of `run` is the one of another run, or `pretrained`.

    Raises:
        OutputError: full disk.
    """
    text = PRETRAINED if str(source) == PRETRAINED else os.path.relpath(source, run)
    write_json(run / "world_model.json", {"source": text})


def world_model_folder(run: Path | str) -> Path:
    """The run folder that holds the world model of `run`: itself, or the one `world_model.json` names.

    Raises:
        CheckpointError: no such run, or a link that leads nowhere.
    """
    folder = run_folder(run)
    link = folder / "world_model.json"
    if checkpoint_folder(folder, "dynamics").is_dir() or not link.is_file():
        return folder
    source = _read_json(link).get("source")
    if not isinstance(source, str):
        raise CheckpointError(f'{link}: got no "source", expected "{PRETRAINED}" or a path: delete it and train again')
    return run_folder(PRETRAINED if source == PRETRAINED else folder / source)


def world_model_checkpoints(run: Path | str) -> dict[str, StageCheckpoint]:
    """The finished `slots` and `dynamics` stages of a run, after checking that they belong together.

    Raises:
        CheckpointError: one is missing or damaged, or the dynamics were trained on other slots.
    """
    folder = world_model_folder(run)
    stages = {name: read_stage(checkpoint_folder(folder, name), name) for name in ("slots", "dynamics")}
    require_parents(stages["dynamics"], {"slots": stages["slots"]})
    return stages


def stage_model(checkpoint: StageCheckpoint) -> tuple[ModelConfig, EnvConfig]:
    """The model and environment config a stage was trained with.

    Raises:
        CheckpointError: its config.json is not one of this version.
    """
    try:
        config = checkpoint.config
        return from_dict(ModelConfig, config["model"], "model."), from_dict(EnvConfig, config["env"], "env.")
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint.path}/config.json: {error}; expected the model and env of this version of playslot_rl: "
            "train that stage again"
        ) from error


def freeze_on(module: nn.Module, device: torch.device | str) -> None:
    """Move a module to a device, into evaluation mode, without gradients for its weights."""
    module.to(device).eval().requires_grad_(False)


def load_savi(run: Path | str, device: torch.device | str = "cpu") -> SAVi:
    """SAVi of a run (or `pretrained`), in eval mode, without gradients for its weights.

    Raises:
        CheckpointError: no finished `slots` stage there, or a damaged one.
    """
    from playslot_rl.modules.savi import SAVi

    checkpoint = read_stage(checkpoint_folder(world_model_folder(run), "slots"), "slots")
    model, env = stage_model(checkpoint)
    with torch.random.fork_rng(devices=[]):
        savi = SAVi(model.savi, env.image_size)
    load_weights(checkpoint, {"savi": savi})
    freeze_on(savi, device)
    return savi


def load_world_model(run: Path | str, device: torch.device | str = "cpu") -> WorldModel:
    """World model of a run or the shipped one (`pretrained`), in eval mode, without gradients for its weights.

    Raises:
        CheckpointError: a stage is missing or damaged, or the dynamics were trained on other slots.
    """
    from playslot_rl.world_model import WorldModel

    stages = world_model_checkpoints(run)
    model, env = stage_model(stages["dynamics"])
    model = replace(model, savi=stage_model(stages["slots"])[0].savi)
    with torch.random.fork_rng(devices=[]):
        world = WorldModel(model, env)
    load_weights(stages["slots"], {"savi": world.savi})
    load_weights(stages["dynamics"], {"inverse_dynamics": world.inverse_dynamics, "predictor": world.predictor})
    freeze_on(world, device)
    return world


def load_agent(run: Path | str, device: torch.device | str = "cpu") -> Agent:
    """World model, policy, action decoder and, if trained, slot oracle of a run; eval mode, no gradients.

    Raises:
        CheckpointError: a stage is missing or damaged, or was trained on other parents.
    """
    from playslot_rl.world_model import Agent

    folder = run_folder(run)
    policy = read_stage(checkpoint_folder(folder, "policy"), "policy")
    require_parents(policy, world_model_checkpoints(run))
    world = load_world_model(run)
    model, _ = stage_model(policy)
    world.config = replace(world.config, policy=model.policy, action_decoder=model.action_decoder)
    with torch.random.fork_rng(devices=[]):
        agent = Agent.untrained(world, oracle="oracle" in policy.meta.get("modules", []))
    modules = {"policy": agent.policy, "action_decoder": agent.action_decoder, "oracle": agent.oracle}
    load_weights(policy, {name: module for name, module in modules.items() if module is not None})
    freeze_on(agent, device)
    return agent
