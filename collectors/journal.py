"""What a collection is: everything its content depends on, and nothing else (not the number of workers); and its
journal: one file per finished episode, each whole or not there, beside the data set that is being made.

A file is an uncompressed npz: the episode's arrays, and its frames as the PNGs that the data set will hold. They are
encoded once, where they were recorded; the export copies the bytes.

Shapes: T agent steps, A action dim, S proprioception, H W image height and width.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import numpy.typing as npt

from playslot_rl.config import EnvConfig, ExperimentConfig, RenderConfig, from_dict
from playslot_rl.config.plain import flatten, nearest, to_dict
from playslot_rl.envs import PROCEDURAL, check_task
from playslot_rl.errors import CheckpointError, ConfigError, OutputError
from playslot_rl.frames import png
from playslot_rl.seeds.episodes import EPISODES, LARGEST_SEED, episode_seed
from playslot_rl.storage.atomic import explain_write_errors, read_json, write_bytes, write_json
from playslot_rl.storage.locks import locked

FORMAT = 1
OFFSETS = {"random": 0, "expert": EPISODES // 2}
"""First episode of a seed: its first half is for random episodes, its second half for the expert's."""
SPEC_NAME = "collection.json"
LOCK_NAME = "lock"
ARRAYS: Final = ("states", "actions", "rewards", "success")


@dataclass(frozen=True)
class CollectionSpec:
    """A collection; `noise` is the deviation of that on the expert's actions, and `env.max_steps` equals `steps`."""

    policy: str
    episodes: int
    steps: int
    seed: int
    noise: float = 0.0
    storage: Literal["image", "video"] = "image"
    env: EnvConfig = field(default_factory=EnvConfig)
    render: RenderConfig = field(default_factory=RenderConfig)
    format: int = FORMAT

    @classmethod
    def make(cls, config: ExperimentConfig, policy: str, episodes: int, steps: int, seed: int) -> CollectionSpec:
        """Check the request and name it.

        Raises:
            ConfigError: unknown policy or environment, an expert where there is none, actions of another width than the
                environment's, too few or too many episodes or steps, or a seed beyond 32 bits.
        """
        if policy not in OFFSETS:
            hint = nearest(policy, OFFSETS, "policy=") or "; choose one of these"
            raise ConfigError(f"unknown policy: got {policy!r}, expected one of {', '.join(sorted(OFFSETS))}{hint}")
        if config.env.name not in PROCEDURAL:
            check_task(config.env, policy == "expert")
        elif policy != "random":
            raise ConfigError(
                f"policy: got {policy} for env={config.env.name}, expected random: its shapes move by themselves; "
                "leave policy out"
            )
        else:
            from playslot_rl.envs import grid_shapes

            grid_shapes.check_actions(config.env)
        if not 1 <= episodes <= EPISODES // 2:
            raise ConfigError(f"episodes: got {episodes}, expected 1 to {EPISODES // 2}; split larger sets over seeds")
        if steps < 2:
            raise ConfigError(f"steps: got {steps}, expected at least 2; set collect.{policy}_steps")
        if not 0 <= seed <= LARGEST_SEED + 1:  # `pipeline` collects some episodes with the seed after the typed one
            raise ConfigError(f"seed: got {seed}, expected 0 to {LARGEST_SEED}; choose a smaller one")
        noise = config.collect.noise if policy == "expert" else 0.0
        env = replace(config.env, max_steps=steps)
        return cls(policy, episodes, steps, seed, noise, config.collect.storage, env, config.render)

    def episode_seed(self, index: int) -> int:
        return episode_seed("collection", self.seed, OFFSETS[self.policy] + index)

    def to_dict(self) -> dict[str, Any]:
        """Plain nested dict; groups of the environment that have their default values (those of other tasks) left out.

        So a data set made before a task with settings of its own was added is still the same collection.
        """
        values, default = to_dict(self), to_dict(EnvConfig())
        values["env"] = {k: v for k, v in values["env"].items() if not isinstance(v, dict) or v != default.get(k)}
        return values

    def difference(self, stored: object) -> str:
        """First setting in which a stored record differs, as `name: got X, expected Y`; empty if none does.

        The record may lack settings that did not exist when it was written.
        """
        found: dict[str, Any] = {}
        if isinstance(stored, dict):
            try:
                found = from_dict(CollectionSpec, stored).to_dict()
            except (TypeError, ValueError):
                found = stored  # the difference names what is foreign in it
        got, expected = flatten(found), flatten(self.to_dict())
        for name in sorted(got.keys() | expected.keys()):
            if got.get(name) != expected.get(name):
                return f"{name}: got {got.get(name)!r}, expected {expected.get(name)!r}"
        return ""


@dataclass(frozen=True)
class RecordedEpisode:
    """One recorded episode; `redrawn` seeds were passed over because it started solved.

    Attributes:
        frames: uint8 [0, 255] (T + 1, H, W, 3).
        states: float32 (T + 1, S).
        actions: float32 (T, A) in [-1, 1].
        rewards: float32 (T,).
        success: bool (T,): whether the agent step solved the task.
    """

    index: int
    seed: int
    redrawn: int
    frames: npt.NDArray[np.uint8]
    states: npt.NDArray[np.float32]
    actions: npt.NDArray[np.float32]
    rewards: npt.NDArray[np.float32]
    success: npt.NDArray[np.bool_]


def encode(episode: RecordedEpisode) -> bytes:
    images = [png(frame) for frame in episode.frames]
    arrays: dict[str, Any] = {name: getattr(episode, name) for name in ARRAYS}
    buffer = io.BytesIO()
    np.savez(
        buffer,
        numbers=np.array([episode.index, episode.seed, episode.redrawn], np.int64),
        images=np.frombuffer(b"".join(images), np.uint8),
        image_sizes=np.array([len(image) for image in images], np.int64),
        **arrays,
    )
    return buffer.getvalue()


def journal_path(out: Path) -> Path:
    """Folder of the journal of the data set `out`."""
    return out.with_name(f"{out.name}.journal")


class Journal:
    """Finished episodes of one collection.

    Raises:
        OutputError: the folder holds something else, or a collection with other settings, or cannot be written.
    """

    def __init__(self, folder: Path, spec: CollectionSpec) -> None:
        self.folder, self.spec = folder, spec
        with explain_write_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
        stored = folder / SPEC_NAME
        if stored.is_file():
            differs = spec.difference(read_spec(stored))
            if differs:
                raise OutputError(
                    f"{folder} holds an unfinished collection with other settings ({differs}); "
                    "repeat them, choose another out=, or delete that folder"
                )
        elif any(p.name != LOCK_NAME and not p.name.startswith(".") for p in folder.iterdir()):
            raise OutputError(f"{folder}: got a folder of something else, expected our journal; choose another out=")
        else:
            write_json(stored, spec.to_dict())

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Keep other processes out; an OutputError where one is collecting into this folder."""
        busy = f"{self.folder}: got another process collecting into it, expected none; wait for it or choose out="
        spec = self.folder / SPEC_NAME
        with contextlib.ExitStack() as stack:
            try:
                stack.enter_context(locked(self.folder / LOCK_NAME, busy))
            except OutputError:
                if spec.is_file():
                    raise
            if not spec.is_file():  # its owner finished, and removed what we have locked
                raise OutputError(
                    f"{self.folder}: got a journal that another process has just removed, expected ours; "
                    "run the same command again"
                )
            for half in self.folder.glob(".*.tmp-*"):  # of killed processes: the lock is ours, nobody is writing them
                half.unlink(missing_ok=True)
            yield

    def path(self, index: int) -> Path:
        return self.folder / f"episode_{index:06d}.npz"

    def add(self, episode: RecordedEpisode) -> None:
        """Store an episode; when this returns it survives a kill and a power cut. An OutputError for a full disk."""
        write_bytes(self.path(episode.index), encode(episode))

    def read(self, index: int) -> RecordedEpisode:
        return self.read_with_images(index)[0]

    def read_with_images(self, index: int, decode: bool = True) -> tuple[RecordedEpisode, list[bytes]]:
        """Load episode `index` and the PNGs of its frames; without `decode` its `frames` are left empty.

        Raises:
            OutputError: its file is missing or damaged, or holds another episode.
        """
        from PIL import Image

        path = self.path(index)
        try:
            with np.load(path, allow_pickle=False) as file:
                there, seed, redrawn = (int(n) for n in file["numbers"])
                arrays = {name: file[name] for name in ARRAYS}
                ends = np.cumsum(file["image_sizes"]).tolist()
                content = file["images"].tobytes()
                images = [content[start:end] for start, end in zip([0, *ends], ends, strict=False)]
                read = [np.asarray(Image.open(io.BytesIO(image))) for image in images] if decode else []
                frames = np.stack(read) if decode else np.zeros(0, np.uint8)
        except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
            raise OutputError(
                f"{path}: got a damaged file ({error}), expected an episode; delete it and run the same command again"
            ) from error
        if there != index:
            raise OutputError(
                f"{path}: got episode {there}, expected {index}; delete it and run the same command again"
            )
        return RecordedEpisode(index, seed, redrawn, frames, **arrays), images

    def missing(self) -> list[int]:
        there = {entry.name for entry in os.scandir(self.folder)}
        return [i for i in range(self.spec.episodes) if self.path(i).name not in there]

    def remove(self) -> None:
        """Delete the journal: the record of what it is goes after all episodes, so that a kill leaves one of ours."""
        order = {SPEC_NAME: 1, LOCK_NAME: 2}
        for path in sorted(self.folder.iterdir(), key=lambda path: order.get(path.name, 0)):
            path.unlink(missing_ok=True)
        shutil.rmtree(self.folder)


def remove_leftover(folder: Path, spec: CollectionSpec) -> None:
    """Delete what is left of the journal of a finished collection, if anything is: the rest of a killed removal."""
    if (folder / SPEC_NAME).is_file():
        Journal(folder, spec).remove()
    elif folder.is_dir() and {path.name for path in folder.iterdir()} <= {LOCK_NAME}:
        shutil.rmtree(folder)


def read_spec(path: Path) -> dict[str, Any]:
    """Read a stored specification; an OutputError where it is not JSON of ours."""
    try:
        return read_json(path, "delete the folder or choose another out=")
    except CheckpointError as error:
        raise OutputError(str(error)) from error
