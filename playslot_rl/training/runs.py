"""Run folders, shipped world models, and what is loaded from them.

The layout of a run (`RUN`), and of the shipped models, is the same:

    RUN/slots/checkpoint       module `savi`
    RUN/dynamics/checkpoint    modules `inverse_dynamics`, `predictor`; parent: slots
    RUN/policy/checkpoint      modules `policy`, `action_decoder`, `oracle` (if trained); parents: slots, dynamics
    RUN/METHOD/checkpoint      a baseline; parents: slots, where it builds on them

A run whose world model lives elsewhere has `RUN/world_model.json`: `{"source": "pretrained/ENV"}`, or a path relative
to RUN. A child names its parents by the fingerprints of their weights and refuses any other.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import nn

from playslot_rl.config import (
    DataConfig,
    DynamicsStageConfig,
    EnvConfig,
    ExperimentConfig,
    ModelConfig,
    from_dict,
    to_dict,
)
from playslot_rl.config.compose import SHIPPED, near_run
from playslot_rl.data.camera_names import with_full_cameras
from playslot_rl.errors import CheckpointError
from playslot_rl.storage.atomic import write_bytes, write_json
from playslot_rl.storage.checkpoints import (
    StageCheckpoint,
    checkpoint_folder,
    load_weights,
    read_stage,
    require_parents,
)
from playslot_rl.storage.folders import new_folder
from playslot_rl.storage.resume import read_json

if TYPE_CHECKING:
    from playslot_rl.modules.savi import SAVi
    from playslot_rl.world_model import Agent, WorldModel


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


def shipped_env(run: Path | str) -> str | None:
    """Environment of the shipped world model that `pretrained/ENV` or `pretrained` (ButtonPress) names, else None."""
    name, _, env = str(run).partition("/")
    return (env or "button_press") if name == SHIPPED else None


def run_folder(run: Path | str) -> Path:
    """`pretrained`, `pretrained/ENV` or a path to the folder that it names.

    Raises:
        CheckpointError: there is no such folder.
    """
    env = shipped_env(run)
    if env is not None:
        return pretrained_folder(env)
    folder = Path(run)
    if not str(run) or not folder.is_dir():
        hint = near_run(str(run))
        raise CheckpointError(f"run={run}: no such folder, expected a run folder or `{SHIPPED}`: check run={hint}")
    return folder


def store_config(config: ExperimentConfig, run: Path) -> None:
    """Write the run's config, with cameras by their full names. Called when everything fits, so that a refused command
    leaves the stored one as it was.

    Raises:
        OutputError: the folder cannot be written.
    """
    write_json(run / "config.json", to_dict(with_full_cameras(config)))


def stored_view(run: Path | str) -> DataConfig:
    """Camera, resizing and stride with which a run's frames were read; the defaults where it says nothing.

    Raises:
        CheckpointError: no such run, or its config is damaged.
    """
    path = run_folder(run) / "config.json"
    data = read_json(path, "restore it").get("data", {}) if path.is_file() else {}
    view = {key: data[key] for key in ("camera", "resize", "stride") if key in data}
    try:
        return from_dict(DataConfig, view, "data.")
    except ValueError as error:
        raise CheckpointError(f"{path} cannot be used: {error}; restore it or start a new run") from error


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
    _copy_files(checkpoint.path, target)


def adopt_training(source: str, run: Path, stage: str, steps: int) -> None:
    """Copy the last checkpoint of another run's training of a stage into a run that has none of its own.

    The training that carries on from it refuses it unless it is the same one. Nothing is copied from a training that
    has not reached `steps`: this run then trains for itself, to the same weights.

    Args:
        source: the other run; empty for none.
        run: the run that takes it over.
        stage: of both.
        steps: of a finished training.

    Raises:
        OutputError: full disk.
    """
    name = f"step_{steps:08d}"
    there, target = Path(source) / stage / "checkpoints" / name, run / stage / "checkpoints" / name
    if not source or target.parent.exists() or not (there / "state.json").is_file():
        return
    _copy_files(there, target)


def _copy_files(source: Path, target: Path) -> None:
    with new_folder(target, replace=True) as temporary:
        for file in sorted(source.iterdir()):
            write_bytes(temporary / file.name, file.read_bytes())


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


def use_world_model(run: Path, parent: Path | str) -> None:
    """Have `run` build on the world model of `parent`: its own, another run's, or a shipped one (`pretrained/ENV`).

    Raises:
        CheckpointError: no such parent.
        OutputError: full disk.
    """
    home, env = world_model_folder(parent), shipped_env(parent)
    if run.resolve() not in (home.resolve(), Path(parent).resolve()):
        write_json(run / "world_model.json", {"source": f"{SHIPPED}/{env}" if env else os.path.relpath(home, run)})


def world_model_folder(run: Path | str) -> Path:
    """The run folder that holds the world model of `run`: itself, or the one `world_model.json` names.

    Raises:
        CheckpointError: no such run, or a link that leads nowhere.
    """
    folder = run_folder(run)
    link = folder / "world_model.json"
    if checkpoint_folder(folder, "dynamics").is_dir() or not link.is_file():
        return folder
    source = read_json(link).get("source")
    if not isinstance(source, str):
        raise CheckpointError(f'{link}: got no "source", expected "{SHIPPED}/ENV" or a path: train again')
    return run_folder(folder / source if shipped_env(source) is None else source)


def world_model_checkpoints(run: Path | str) -> dict[str, StageCheckpoint]:
    """The finished `slots` and `dynamics` stages of a run, after checking that they belong together.

    Raises:
        CheckpointError: one is missing or damaged, or the dynamics were trained on other slots.
    """
    folder = world_model_folder(run)
    stages = {name: read_stage(checkpoint_folder(folder, name), name) for name in ("slots", "dynamics")}
    require_parents(stages["dynamics"], {"slots": stages["slots"]})
    return stages


def stage_config[Group](checkpoint: StageCheckpoint, cls: type[Group], name: str) -> Group:
    """A group of the config a stage was trained with; all stages store `env`.

    Raises:
        CheckpointError: its config.json is not one of this version.
    """
    try:
        return from_dict(cls, checkpoint.config[name], f"{name}.")
    except (KeyError, TypeError, ValueError) as error:
        raise CheckpointError(
            f"{checkpoint.path}/config.json: {error}; expected the {name} of this version of playslot_rl: train that "
            "stage again"
        ) from error


def stage_model(checkpoint: StageCheckpoint) -> tuple[ModelConfig, EnvConfig]:
    """The model and environment config a stage was trained with.

    Raises:
        CheckpointError: its config.json is not one of this version.
    """
    return stage_config(checkpoint, ModelConfig, "model"), stage_config(checkpoint, EnvConfig, "env")


def freeze_on(module: nn.Module, device: torch.device | str) -> None:
    """Move a module to a device, into evaluation mode, without gradients for its weights."""
    module.to(device).eval().requires_grad_(False)


def slots_checkpoint(run: Path | str) -> StageCheckpoint:
    """The finished SAVi that a run builds on.

    Raises:
        CheckpointError: there is none.
    """
    return read_stage(checkpoint_folder(world_model_folder(run), "slots"), "slots")


def load_savi(run: Path | str, device: torch.device | str = "cpu") -> SAVi:
    """SAVi of a run (or `pretrained`), in eval mode, without gradients for its weights.

    Raises:
        CheckpointError: no finished `slots` stage there, or a damaged one.
    """
    from playslot_rl.modules.savi import SAVi

    checkpoint = slots_checkpoint(run)
    model, env = stage_model(checkpoint)
    with torch.random.fork_rng(devices=[]):
        savi = SAVi(model.savi, env.image_size)
    load_weights(checkpoint, {"savi": savi})
    freeze_on(savi, device)
    return savi


def world_model_config(stages: Mapping[str, StageCheckpoint]) -> tuple[ModelConfig, EnvConfig]:
    """The model and environment config of a world model's `slots` and `dynamics`.

    Raises:
        CheckpointError: a config.json is not one of this version.
    """
    model, env = stage_model(stages["dynamics"])
    return replace(model, savi=stage_model(stages["slots"])[0].savi), env


def trained_horizon(dynamics: StageCheckpoint) -> int:
    """Steps after the first frame that a predictor was trained to roll out.

    Raises:
        CheckpointError: its config.json is not one of this version.
    """
    own = stage_config(dynamics, DynamicsStageConfig, "dynamics")
    return own.seed_frames - 1 + own.predicted_frames


def load_world_model(run: Path | str, device: torch.device | str = "cpu") -> WorldModel:
    """World model of a run or the shipped one (`pretrained`), in eval mode, without gradients for its weights.

    Raises:
        CheckpointError: a stage is missing or damaged, or the dynamics were trained on other slots.
    """
    from playslot_rl.world_model import WorldModel

    stages = world_model_checkpoints(run)
    with torch.random.fork_rng(devices=[]):
        world = WorldModel(*world_model_config(stages))
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
