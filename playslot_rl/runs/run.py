"""A run on disk, or a pretrained model, which is laid out like one:

    RUN/slots/checkpoint       module `savi`
    RUN/dynamics/checkpoint    modules `inverse_dynamics`, `predictor`; parent: slots
    RUN/policy/checkpoint      modules `policy`, `action_decoder`, `oracle` (if trained); parents: slots, dynamics
    RUN/METHOD/checkpoint      another method; parents: slots, where it builds on them

A run whose world model lives elsewhere has `RUN/world_model.json`: `{"source": "pretrained/ENV"}`, or a path relative
to RUN. A child names its parents by the fingerprints of their weights and refuses any other.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from playslot_rl.config import DataConfig, EnvConfig, ExperimentConfig, ModelConfig, from_dict, to_dict
from playslot_rl.config.compose import PRETRAINED, near_run, stored_config
from playslot_rl.config.plain import nearest
from playslot_rl.data.contents import with_full_cameras
from playslot_rl.errors import CheckpointError
from playslot_rl.storage.atomic import json_or_nothing, read_json, write_bytes, write_json
from playslot_rl.storage.folders import copy_files, new_folder

if TYPE_CHECKING:
    import torch

    from playslot_rl.modules.savi import SAVi
    from playslot_rl.storage.checkpoints import StageCheckpoint
    from playslot_rl.world_model import Agent, WorldModel


def pretrained_folder(env: str = "button_press") -> Path:
    """Folder of a task's pretrained model; a CheckpointError where there is none."""
    import importlib.resources

    root = Path(str(importlib.resources.files("playslot_rl.pretrained")))
    names = sorted(path.parents[2].name for path in root.glob("*/dynamics/checkpoint/meta.json"))
    if env not in names:
        raise CheckpointError(
            f"no pretrained world model for env={env}, expected one of: {', '.join(names) or 'none'}"
            f"{nearest(env, names, f'{PRETRAINED}/') or '; train one by `playslot pipeline`'}"
        )
    return root / env


class Run:
    """A run, opened once; what was read of it is kept, so open it again after it was trained on. Whatever reads a stage
    raises a CheckpointError where that is missing, damaged, of another version, or was trained on other parents. The
    folder of a run to write may not be there yet; `pretrained` is the task whose pretrained model it is.
    """

    def __init__(self, folder: Path, pretrained: str = "") -> None:
        self.folder, self.pretrained = folder, pretrained
        self._stages: dict[str, StageCheckpoint] = {}

    def __repr__(self) -> str:
        return f"Run({self.name})"

    @classmethod
    def open(cls, name: Path | str) -> Run:
        """`pretrained/ENV`, `pretrained` (ButtonPress's) or a folder; a CheckpointError where there is none.

        Examples:
            >>> run = Run.open("pretrained/block_push")
            >>> run.stage("dynamics").meta["parents"] == {"slots": run.stage("slots").fingerprint}
            True
        """
        first, _, env = str(name).partition("/")
        if first == PRETRAINED:
            return cls(pretrained_folder(env or "button_press"), env or "button_press")
        folder = Path(name).expanduser()
        if (folder / "meta" / "info.json").is_file():
            raise CheckpointError(f"run={name}: got a data set, expected the folder of a run: data sets are data.root=")
        if not str(name) or not folder.is_dir():
            raise CheckpointError(
                f"run={name}: no such folder, expected a run folder or `{PRETRAINED}`: check run={near_run(str(name))}"
            )
        return cls(folder)

    @classmethod
    def of(cls, config: ExperimentConfig, otherwise: Path | str = "") -> Run:
        """The run that a command reads: `run`, where `pretrained` is the task's own, or else another."""
        return cls.open(f"{PRETRAINED}/{config.env.name}" if config.run == PRETRAINED else config.run or otherwise)

    @property
    def name(self) -> str:
        """As `Run.open` takes it."""
        return f"{PRETRAINED}/{self.pretrained}" if self.pretrained else str(self.folder)

    @cached_property
    def config(self) -> ExperimentConfig:
        """As stored; a ConfigError where it is missing or not one of this version."""
        return stored_config(self.folder)

    @cached_property
    def view(self) -> DataConfig:
        """Camera, resizing and stride with which the frames were read; the defaults where the run says nothing."""
        path = self.folder / "config.json"
        data = read_json(path, "restore it").get("data", {}) if path.is_file() else {}
        try:
            return from_dict(DataConfig, {key: data[key] for key in ("camera", "resize", "stride") if key in data}, "data.")
        except ValueError as error:
            raise CheckpointError(f"{path} cannot be used: {error}; restore it or start a new run") from error

    def result(self, name: Path | str, facts: Mapping[str, Any]) -> dict[str, Any] | None:
        """What an evaluation wrote into this file before, if `facts` (parts of its result) are the same."""
        stored = json_or_nothing(self.folder / name)
        return stored if stored and {key: stored.get(key) for key in facts} == facts else None

    # Stages

    @cached_property
    def world_run(self) -> Run:
        """The run that holds the world model of this one: itself, or the one that `world_model.json` names."""
        link = self.folder / "world_model.json"
        if self.place("dynamics").is_dir() or not link.is_file():
            return self
        source = read_json(link).get("source")
        if not isinstance(source, str):
            raise CheckpointError(f'{link}: got no "source", expected "{PRETRAINED}/ENV" or a path: train again')
        if source.partition("/")[0] == PRETRAINED:
            return Run.open(source)
        if not (self.folder / source).is_dir():
            raise CheckpointError(
                f"run={self.folder}: got no world model, expected it at {Path(os.path.normpath(self.folder / source))} "
                "(world_model.json): copy that run along, or export the policy where both are"
            )
        return Run.open(self.folder / source)

    def place(self, stage: str) -> Path:
        """`RUN/STAGE/checkpoint`, there or not."""
        return self.folder / stage / "checkpoint"

    def has(self, stage: str) -> bool:
        """Whether the stage is finished in this run's own folder."""
        return (self.place(stage) / "meta.json").is_file()

    def own(self, stage: str) -> StageCheckpoint:
        """A finished stage of this run's own folder, whatever its parents."""
        from playslot_rl.storage.checkpoints import read_stage

        if stage not in self._stages:
            self._stages[stage] = read_stage(self.place(stage), stage)
        return self._stages[stage]

    def stage(self, stage: str, *parents: str) -> StageCheckpoint:
        """A finished stage, those of the world model from where it lives, and trained on the parents of that name;
        `dynamics` and `policy` are held against theirs in any case.
        """
        from playslot_rl.storage.checkpoints import require_parents

        world = ("slots", "dynamics")
        found = (self.world_run if stage in world else self).own(stage)
        if stage in ("dynamics", "policy"):
            parents = world[:1] if stage == "dynamics" else world
        require_parents(found, {name: self.stage(name) for name in parents})
        return found

    @property
    def world_stages(self) -> dict[str, StageCheckpoint]:
        """`slots` and `dynamics`."""
        return {name: self.stage(name) for name in ("slots", "dynamics")}

    @property
    def world_config(self) -> tuple[ModelConfig, EnvConfig]:
        """Sizes and task of the world model."""
        slots, dynamics = self.world_stages.values()
        model, env = dynamics.sizes
        return replace(model, savi=slots.sizes[0].savi), env

    # Networks, restored in evaluation mode, without gradients

    def load_savi(self, device: torch.device | str = "cpu") -> SAVi:
        from playslot_rl.modules.savi import SAVi

        slots = self.stage("slots")
        model, env = slots.sizes
        return slots.restore(lambda: SAVi(model.savi, env.image_size), "savi", device)

    def load_world_model(self, device: torch.device | str = "cpu") -> WorldModel:
        """SAVi, inverse dynamics and predictor."""
        from playslot_rl.world_model import WorldModel

        dynamics, sizes = self.stage("dynamics"), self.world_config
        world = dynamics.restore(lambda: WorldModel(*sizes), ("inverse_dynamics", "predictor"), device)
        world.savi = self.load_savi(device)
        return world

    def load_agent(self, device: torch.device | str = "cpu") -> Agent:
        """World model, policy, action decoder and, if trained, slot oracle."""
        from playslot_rl.world_model import Agent

        policy = self.stage("policy")
        world = self.load_world_model(device)
        own, world.env = policy.sizes  # videos without actions do not say how wide these are
        world.config = replace(world.config, policy=own.policy, action_decoder=own.action_decoder)
        oracle = ("oracle",) if "oracle" in policy.meta.get("modules", []) else ()
        parts = ("policy", "action_decoder", *oracle)
        return policy.restore(lambda: Agent.untrained(world, oracle=bool(oracle)), parts, device)

    # Writing

    def store(self, config: ExperimentConfig) -> None:
        """Write the run's config, with cameras by their full names; called when everything fits, so that a refused
        command leaves the stored one as it was.
        """
        write_json(self.folder / "config.json", to_dict(with_full_cameras(config)))

    def require_room(self, checkpoint: StageCheckpoint) -> None:
        """Check that the run has no checkpoint of that stage, or this one; else a CheckpointError."""
        stage = checkpoint.stage
        if self.has(stage) and self.own(stage).fingerprint != checkpoint.fingerprint:
            raise CheckpointError(
                f"{self.folder} has {stage} {self.own(stage).fingerprint} of its own, got {stage} "
                f"{checkpoint.fingerprint} from {checkpoint.path}: leave run= out to build on its own, or use "
                "another out="
            )

    def take(self, checkpoint: StageCheckpoint) -> None:
        """Copy a finished stage into this run, so that it is whole, if there is room for it."""
        self.require_room(checkpoint)
        target = self.place(checkpoint.stage)
        if not target.exists():
            copy_files(checkpoint.path, target)

    def build_on(self, parent: Run) -> None:
        """Name the world model of `parent` as that of this run, unless it is its own."""
        home = parent.world_run.folder
        if self.folder.resolve() not in (home.resolve(), parent.folder.resolve()):
            source = parent.name if parent.pretrained else os.path.relpath(home, self.folder)
            write_json(self.folder / "world_model.json", {"source": source})
