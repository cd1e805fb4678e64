"""A stage names itself once: its record says when it is finished, what resumes it, and what is saved."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, Literal

import torch
from torch import nn

from playslot_rl.config import EnvConfig, ExperimentConfig, to_dict
from playslot_rl.config.plain import put
from playslot_rl.config.roles import by_default, without
from playslot_rl.config.stage_spec import StageSpec, group_of
from playslot_rl.data.action_limits import ActionLimits, said, scaled
from playslot_rl.data.agreement import say_once
from playslot_rl.data.clips import Clips
from playslot_rl.data.demonstrations import DemonstrationSplit, say_averaged, split_demonstrations
from playslot_rl.data.drawn_clips import DrawnClips
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.tasks import require_tasks, say_untaught
from playslot_rl.data.videos import open_videos
from playslot_rl.data.weighted import say_unlike
from playslot_rl.errors import CheckpointError, DataError, OutputError
from playslot_rl.runs import Run
from playslot_rl.runs.opening import STAGE_LOCK
from playslot_rl.runtime.devices import open_device
from playslot_rl.runtime.processes import here, wait
from playslot_rl.storage.atomic import explain_write_errors, json_or_nothing
from playslot_rl.storage.checkpoints import (
    StageCheckpoint,
    checkpoint_folder,
    read_stage,
    require_config,
    require_parents,
    require_whole,
    save_stage,
    training_command,
)
from playslot_rl.storage.locks import locked
from playslot_rl.training.pace import Pace
from playslot_rl.training.taught import taught

_ROLES: Final[Mapping[str, Literal["train", "demos", ""]]] = {
    "videos": "train", "demos": "demos", "labelled": "demos", "": "",
}  # fmt: skip
LABELS: Final = "behaviour.labelled_demos"
PATIENCE: Final = 10.0
"""Seconds in which the children of a killed training end."""


@dataclass(frozen=True)
class StageRecord:
    """A stage that a command trains: what it is, and of which config, data and parents.

    Attributes:
        spec: what identifies it.
        parents: checkpoints it is trained on, by stage.
        groups: groups of the config that are the parents' instead of the command's.
        ready: called before the first step; puts what the stage builds on into the run.
        pace: the time that it has; None trains as many steps as the config says.
    """

    spec: StageSpec
    run: Path
    config: ExperimentConfig
    parents: Mapping[str, StageCheckpoint] = field(default_factory=dict)
    groups: Mapping[str, Any] = field(default_factory=dict)
    ready: Callable[[], None] = lambda: None
    pace: Pace | None = None

    @property
    def name(self) -> str:
        """The stage; its folder in the run is called so."""
        return self.spec.name

    @property
    def role(self) -> Literal["train", "demos", ""]:
        """Of the data set, in the checkpoint, too: videos (`train`) or demonstrations (`demos`)."""
        return _ROLES[self.spec.data]

    @cached_property
    def stored(self) -> dict[str, Any]:
        """The checkpoint's config, nested plain values."""
        return {self.spec.stored_name(group): to_dict(self._group(group)) for group in self.spec.groups}

    @property
    def folder(self) -> Path:
        """`RUN/NAME`."""
        return self.run / self.name

    @property
    def roots(self) -> str:
        """The data sets that the command names, `data.demos` or else `data.root` for demonstrations; may be none."""
        data = self.config.data
        return (data.demos or data.root) if self.role == "demos" else data.root

    @cached_property
    def videos(self) -> EpisodeFrames:
        """What the command names. Raises DataError: nothing, or it cannot be read."""
        what = training_command(self.name).partition(" ")[0]
        return open_videos(self.config, self.roots, what, self.role == "demos")

    @cached_property
    def demos(self) -> DemonstrationSplit:
        """The demonstrations a stage trains on, and those that only measure.

        Raises:
            DataError: none are named, they cannot be read, or there are fewer than `demos`.
        """
        config = self.config
        data, most = config.data, config.collect.validation_episodes
        if self.videos.shares is not None:
            raise DataError(
                f"data.demos={self.roots}: got weights, expected none: a policy is cloned from every transition of "
                "its demonstrations alike; leave the weights out"
            )
        acted = self.spec.data == "labelled"
        found = split_demonstrations(self.videos, config.demos, data.held_out, most, data.draw, acted)
        require_tasks(found.trained, config.env)
        say_unlike(config.env, self.roots)
        say_untaught(found.trained, config.env, config.behaviour.labelled_demos if self.spec.some_labelled else None)
        if found.trained.limits is not None:  # a robot's own actions
            say_averaged(data)
        return found

    def seen(self, frames: int) -> dict[str, Any]:
        """For the checkpoint of a stage that sees clips of so many frames: how many episodes there are."""
        return {"episodes": self.data.episodes, "clip_frames": frames}

    def clips(self, frames: int, shown: int = 32) -> Clips:
        """Clips of the videos, some of their episodes (`data.validation`) held out; `shown` of these at most validate.

        Raises:
            ConfigError: `data.drawn`, and settings of the task that do not fit one another.
            DataError: no episode has so many frames.
        """
        data, env = self.config.data, self.config.env
        given = self.videos, frames, data.validation, self.config.seed, shown
        if data.drawn:  # of the data set only what validates is read
            return DrawnClips(env, data.stride, *given, False)
        return Clips(*given, data.device == "auto")

    @cached_property
    def labelled(self) -> EpisodeFrames | None:
        """The labelled demonstrations of the draw, whose actions count beside the videos; None where none do. Raises
        as `demos`.
        """
        if not self.spec.sees_labels(self.config):
            return None
        config = replace(self.config, demos=self.config.behaviour.labelled_demos)
        return replace(self, spec=replace(self.spec, data="labelled"), config=config).demos.trained

    @property
    def labels(self) -> str:
        """How many these are, and their fingerprint."""
        found = self.labelled
        return "none" if found is None else f"{found.recordings} ({found.fingerprint})"

    @property
    def drawn(self) -> str:
        """What is drawn instead of the videos (`data.drawn`); empty where nothing is."""
        if not self.config.data.drawn or self.role != "train":
            return ""
        return ", ".join(f"{key}={value}" for key, value in to_dict(self.config.env.grid).items())

    @property
    def data(self) -> EpisodeFrames:
        """What the stage learns from."""
        return self.demos.trained if self.role == "demos" else self.videos

    @property
    def limits(self) -> ActionLimits | None:
        """The range of the actions that a stage learns to give; None for those of our simulators."""
        return self.data.limits if self.role == "demos" else None

    @cached_property
    def actions(self) -> dict[str, Any] | None:
        """That range, plain values."""
        return None if self.limits is None else self.limits.plain()

    @cached_property
    def device(self) -> torch.device:
        """The device that computes, with threads and allocator set.

        Raises:
            ConfigError: no such device.
        """
        return open_device(self.config.device, self.config.threads)

    @cached_property
    def world(self) -> Run:
        """The run of the world model that the stage builds on.

        Raises:
            CheckpointError: there is none.
        """
        return Run.of(self.config, self.run)

    @cached_property
    def prints(self) -> dict[str, str]:
        """Fingerprints of the parents, by stage."""
        return {name: checkpoint.fingerprint for name, checkpoint in self.parents.items()}

    def finished(self) -> StageCheckpoint | None:
        """The finished stage, after saying that it is skipped; None if it is not finished.

        Raises:
            CheckpointError: it was trained otherwise, or is damaged.
        """
        path = checkpoint_folder(self.run, self.name)
        if not (path / "meta.json").is_file():
            return None
        done = read_stage(path, self.name)
        require_whole(done)
        require_parents(done, self.parents)
        require_config(done, self._with_started(self.finishes(), done), self.spec.typed)
        facts: list[tuple[str, object, object]] = [("seed", self.config.seed, done.meta.get("seed", self.config.seed))]
        own = self
        if self.role and self.roots:  # a finished stage can be asked for without
            old = next(iter(done.meta["data"].values()), "none")
            own = self._as(done, old)
            facts.append(("data", own.data.fingerprint, old))
            cameras, seen = (str(each).split(",") for each in (own.data.camera, done.meta.get("camera") or ""))
            if any(seen):  # versions before named the first of several
                facts.append(("data.camera", ",".join(cameras[: len(seen)]), ",".join(seen)))
            facts.append(("data.drawn", self.drawn or "false", done.meta.get("drawn") or "false"))
            facts += self._windows(done) if self.role == "train" else []
        if self.spec.labels and self.roots:
            facts.append((LABELS, self.labels, done.meta.get("labelled")))
        if self.role == "demos" and self.roots:
            ends = [said(plain if scaled(plain) else None) for plain in (self.actions, done.meta.get("actions"))]
            facts.append(("actions", ends[0], ends[1]))
        if self.role == "demos" and not self.config.model.policy.goal:
            facts.append(("env.task", self._group("env").task, done.group(EnvConfig, "env").task))
        for name, got, known in facts:
            if got != known:
                raise CheckpointError(
                    f"{name}: got {got}, expected {known} as {path} was trained with: use another out="
                )
        if own is not self:
            kept = own.config.data.held_out
            say_once(f"note: {self.name}: got data.held_out={self.config.data.held_out}, but was trained with {kept}")
        print(f"{self.name}: finished before ({done.meta.get('steps')} steps), skipped", flush=True)
        return done

    def _as(self, done: StageCheckpoint, fingerprint: str) -> StageRecord:
        """With as many demonstrations held out as from a finished model of videos: those of a policy come later, and
        versions before held none out of sets that were named in two ways."""
        own = self.config.data
        if self.role != "train" or self.data.fingerprint == fingerprint:
            return self
        for kept in {done.meta.get("held_out") or 0, 0} - {own.held_out}:
            other = replace(self, config=replace(self.config, data=replace(own, held_out=kept)))
            if other.data.fingerprint == fingerprint:
                return other
        return self

    def _with_started(self, wanted: dict[str, Any], done: StageCheckpoint) -> dict[str, Any]:
        """With the place from which slots started as it was said then, where the same ones lie at that of now."""
        own, old = (config.get("slots", {}).get("start_from") for config in (wanted, done.config))
        if own and old and own != old and Run.open(own).stage("slots").fingerprint == done.meta.get("started_from"):
            wanted["slots"]["start_from"] = old
        return wanted

    def _windows(self, done: StageCheckpoint) -> list[tuple[str, object, object]]:
        """What decides which clips a model of videos saw, each as it is now and was then; checkpoints of before do not
        say it, but the run's config may.
        """
        told = json_or_nothing(self.run / "config.json").get("data", {}) | done.meta
        keys = ("validation", "shuffle_buffer") if self.config.data.stream else ("validation",)
        own = [(key, getattr(self.config.data, key)) for key in keys]
        return [(f"data.{key}", value, told.get(key, value)) for key, value in own]

    def finishes(self) -> dict[str, Any]:
        """Parts of `stored`, nested as there, that a finished stage must share."""
        picked: dict[str, Any] = {}
        for key in (*self.spec.keys, *self.spec.settings):
            put(picked, self.spec.stored_name(key), self._value(key, free=False))
        return picked

    def resumes(self) -> dict[str, Any]:
        """Plain values that a half-finished stage must share, beside its settings and the seed."""
        picked: dict[str, Any] = {}
        for key in (*self.spec.keys, *self.spec.begun):
            put(picked, self.spec.stored_name(key, begun=True), self._value(key))
        data: dict[str, Any] = {}
        if self.role:
            data = {"data": self.data.fingerprint, "data.camera": self.data.camera}
        if self.role == "demos" and scaled(self.actions):
            data["actions"] = said(self.actions)
        if self.role == "demos" and self._group("env").tasks and not self.config.model.policy.goal:
            data["env.task"] = self._group("env").task
        if self.labelled is not None:
            data[LABELS] = self.labels
        if self.role == "train":
            data["data.validation"] = self.config.data.validation
            if self.drawn:
                data["data.drawn"] = self.drawn
            if self.config.data.stream:  # other windows than from the cache
                data["data.shuffle_buffer"] = self.config.data.shuffle_buffer
        return {**picked, **data, **self.prints}

    def _group(self, name: str) -> Any:
        """A group of the config as the stage is trained with it, less what only says where a job is made."""
        group = self.groups[name] if name in self.groups else attrgetter(name)(self.config)
        return by_default(group, "machine")

    def _value(self, key: str, free: bool = True) -> Any:
        """A key or group of the config, plain; without those keys that may differ unless `free`."""
        owner = group_of(key)
        config = self._group(owner)
        value: Any = to_dict(config) if free else without(config, "free")
        for name in key.removeprefix(owner).split(".")[1:]:
            value = value[name]
        return value

    @contextmanager
    def training(self) -> Iterator[Callable[[], None]]:
        """Keep other commands from training this stage of this run inside the block.

        Yields:
            What to call before the first step, when nothing speaks against it: it makes the folder a run, with the
            command's config and what the stage builds on. Until then nothing is written but the lock, and that only
            in a folder that is there.

        Raises:
            OutputError: another command trains it, or the folder cannot be written.
        """
        busy = (
            f"out={self.run}: got a run whose {self.name} another command is training, expected none: wait for it, "
            "or use another out="
        )
        with ExitStack() as held:

            def hold() -> None:
                with explain_write_errors(self.folder):
                    self.folder.mkdir(parents=True, exist_ok=True)
                held.enter_context(locked(self.folder / STAGE_LOCK, busy, PATIENCE))

            begun = self.folder.is_dir()
            if begun and here().first:
                hold()

            def begin() -> None:
                nonlocal begun
                if here().first:
                    if not begun:
                        hold()
                        if any(self.folder.glob("**/checkpoint*/*")):  # of one that was quicker, and has ended
                            raise OutputError(busy)
                    begun = True
                    Run(self.run).store(self.config)
                    self.ready()

            yield begin

    def save(
        self,
        modules: Mapping[str, nn.Module],
        metrics: Mapping[str, float],
        steps: int,
        seconds: float,
        extra: Mapping[str, Any],
    ) -> StageCheckpoint:
        """Write the finished stage; `extra` goes to its `meta.json`. The first of several processes does, all read it.

        Raises:
            OutputError: full disk, or a folder that cannot be written.
        """
        known = taught(self.data, self.config, extra, self.role == "demos") if self.role else {}
        if self.role == "demos":
            tasks = [] if self.data.tasks is None else self.data.tasks.tolist()
            known |= {"actions": self.actions, "tasks": sorted({task for task in tasks if task})}
        if self.spec.labels:
            known["labelled"] = self.labels
        path = checkpoint_folder(self.run, self.name)
        if not here().first:
            wait()
            return read_stage(path, self.name)
        done = save_stage(
            path,
            stage=self.name,
            modules=modules,
            config=self.stored,
            data={self.role: self.data.fingerprint} if self.role else {},
            parents=self.prints,
            metrics=metrics,
            steps=steps,
            seconds=seconds,
            extra={"seed": self.config.seed, **(self._shown() if self.role else {}), **known, **extra},
        )
        wait()
        return done

    def _shown(self) -> dict[str, Any]:
        """What the frames are that the stage was shown: how many a second, and of which cameras."""
        return {"fps": self.data.fps, **({"drawn": self.drawn} if self.drawn else {}), "camera": self.data.camera}

    def say_unlike(self) -> None:
        """Say where its frames are of another rate or camera than those its parents were shown: a line each, once."""
        own, cameras = self.data, self.data.camera.split(",")
        rates = [float(parent.meta["fps"]) for parent in self.parents.values() if parent.meta.get("fps")]
        seen = [str(parent.meta["camera"]) for parent in self.parents.values() if parent.meta.get("camera")]
        other = next((fps for fps in rates if f"{fps:g}" != f"{own.fps:g}"), None)
        if other is not None:
            said = (
                f"note: {own.name}: got {own.fps:g} frames a second, expected {other:g} as the run's model was shown: "
            )
            say_once(f"{said}record at that rate, or choose data.stride=")
        unlike = next((known for known in seen if not {*cameras} <= {*known.split(",")}), None)
        if unlike is not None:
            said = f"note: {own.name}: got frames of {own.camera}, expected {unlike} as the run's model was shown: "
            say_once(f"{said}choose by data.camera=, unless they show the same view")
