"""Opening data sets for training: decoded frames by row number, whatever LeRobot v3.0 data set they come from.

A data set is decoded once, into the frame cache: an uncompressed, memory-mapped uint8 array.

Shapes: F frames, E episodes, H W image height and width, A action width.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.config.weights import is_remote
from playslot_rl.data.action_limits import ActionLimits, limits_of
from playslot_rl.data.agreement import open_files, say_once
from playslot_rl.data.cache import (
    ENTRY_NAME,
    CachePlace,
    build_once,
    cache_folder,
    load_cached,
    note_read,
    room,
    settings,
)
from playslot_rl.data.contents import Contents
from playslot_rl.data.frame_build import FrameArray, build_frames
from playslot_rl.data.metadata import robot_of, stated_size
from playslot_rl.data.prints import episode_origins, files_fingerprint
from playslot_rl.data.remote import open_remote
from playslot_rl.data.stream import FrameStream
from playslot_rl.data.tables import Array
from playslot_rl.data.views import FrameRows, Frames, concatenate, views_of_one
from playslot_rl.errors import DataError
from playslot_rl.storage.atomic import write_json

if TYPE_CHECKING:
    from torch import Tensor

    from playslot_rl.data.weighted import Shares

_FORMAT = "1"  # of the frame cache


@dataclass(frozen=True)
class EpisodeFrames:
    """A data set's frames and labels by row. Episode e is rows `starts[e]` to `starts[e] + lengths[e]`.

    An episode of n rows has n - 1 transitions: row t and row t + 1 with the action of row t. The action of an episode's
    last row is padding.

    Attributes:
        frames: uint8 (F, H, W, 3), [0, 255], memory-mapped; index it by integers, slices or integer arrays.
        starts, lengths: int64 (E,).
        actions: float32 (F, A), as they were recorded, NaN in those of several sets that have none; None if none has.
        unlabelled: names of those sets, with commas.
        seeds: int64 (E,), or None.
        fingerprint: content hash, 16 hex digits.
        robot: what was recorded, as the data set says; empty where it says nothing.
        name: the folder it was read from, for people.
        shares: of several sets that are drawn from with weights, which rows are whose; None draws all windows alike.
        tasks: what is to be done in each episode, str (E,); None where it was not read.
        recorded: which recorded episode each is a view of, 0 to R - 1, int64 (E,); None where each is one of its own.
        limits: what actions in [-1, 1] stand for; None for those of our simulators, which are so, and without actions.
        states: proprioception, float32 (F, S), or None.
        origins: of each episode a hash of its actions, or where they say nothing of its pictures, str (E,): the same in
            any set that it is copied to, and however it is viewed (`playslot_rl.data.prints`); None where it is not
            known.
        turns: whether its tasks take turns (`playslot_rl.data.turns`), in what is drawn from it, too.
    """

    frames: FrameRows
    starts: npt.NDArray[np.int64]
    lengths: npt.NDArray[np.int64]
    actions: npt.NDArray[np.float32] | None
    seeds: npt.NDArray[np.int64] | None
    fingerprint: str
    fps: float
    task: str
    camera: str
    robot: str = ""
    name: str = ""
    shares: Shares | None = None
    limits: ActionLimits | None = None
    states: npt.NDArray[np.float32] | None = None
    tasks: npt.NDArray[np.str_] | None = None
    recorded: npt.NDArray[np.int64] | None = None
    unlabelled: str = ""
    origins: npt.NDArray[np.str_] | None = None
    turns: bool = False

    @property
    def episodes(self) -> int:
        """E."""
        return len(self.starts)

    @property
    def recordings(self) -> int:
        """R, the episodes as they were recorded: several cameras see one each."""
        return self.episodes if self.recorded is None else int(self.recorded.max()) + 1

    @property
    def numbers(self) -> npt.NDArray[np.int64]:
        """Number of the recorded episode of each, int64 (E,)."""
        return np.arange(self.episodes) if self.recorded is None else self.recorded

    @property
    def first_views(self) -> npt.NDArray[np.int64]:
        """Which episode shows each recorded one first, int64 (R,)."""
        found: npt.NDArray[np.int64] = np.unique(self.numbers, return_index=True)[1]
        return found

    @property
    def scenes(self) -> npt.NDArray[np.int64]:
        """Number of what each shows, a task before a camera, int64 (E,)."""
        order = np.argsort(self.numbers, kind="stable")
        first = np.searchsorted(self.numbers[order], self.numbers[order])
        view = np.empty_like(order)
        view[order] = np.arange(self.episodes) - first
        tasks = np.zeros_like(view) if self.tasks is None else np.unique(self.tasks, return_inverse=True)[1]
        found: npt.NDArray[np.int64] = tasks * (view.max() + 1) + view
        return found

    @property
    def silent(self) -> npt.NDArray[np.bool_]:
        """Which episodes have no actions though others have some, bool (E,)."""
        if self.actions is None or not self.unlabelled:
            return np.zeros(self.episodes, dtype=np.bool_)
        return np.asarray(np.isnan(self.actions[self.starts]).all(axis=1))

    @property
    def image_size(self) -> tuple[int, int]:
        """(H, W)."""
        return int(self.frames.shape[1]), int(self.frames.shape[2])

    def pixels(self, rows: npt.ArrayLike) -> Tensor:
        """Frames of rows of any shape (...) as a uint8 tensor (..., 3, H, W)."""
        import torch

        frames = np.ascontiguousarray(self.frames[np.asarray(rows)])
        note_read(frames.nbytes)
        return torch.from_numpy(frames).movedim(-1, -3)

    def episode_rows(self, episode: int) -> npt.NDArray[np.int64]:
        return np.arange(self.starts[episode], self.starts[episode] + self.lengths[episode])

    def require_actions(self, width: int | None = None) -> npt.NDArray[np.float32]:
        """The actions; a DataError where there are none, or some of another width."""
        if self.actions is None:
            raise DataError(
                "got a data set without actions, expected the feature `action`, of one width in all sets: use labelled "
                "demonstrations"
            )
        if width is not None and self.actions.shape[1] != width:
            raise DataError(
                f"got actions of width {self.actions.shape[1]}, expected {width} as in env.action_dim: "
                "use a data set of this robot, or set env.action_dim"
            )
        return self.actions

    def require_states(self) -> npt.NDArray[np.float32]:
        """Proprioception (F, S); a DataError where there is none."""
        if self.states is None:
            raise DataError(
                "got a data set without proprioception, expected the feature `observation.state`: record it, or name a "
                "method that sees the camera alone"
            )
        return self.states


def open_sources(
    roots: str | Path | Sequence[str | Path],
    camera: str = "",
    cache: CachePlace = "",
    *,
    image_size: int | None = None,
    resize: bool = False,
    buffer: int | None = None,
) -> EpisodeFrames:
    """Open LeRobot v3.0 data sets as one; with several cameras each episode comes once for each of them.

    Frames are decoded once, into the frame cache; with a `buffer` they are decoded while they are read
    (`playslot_rl.data.stream`). Labels that not every data set has are dropped, but actions.

    Args:
        roots: folders, or a text with commas; with a `buffer` also addresses of data sets on the Hub.
        camera: image or video feature, or several with commas; empty means the only one.
        cache: empty means `$PLAYSLOT_CACHE` or `~/.cache/playslot_rl`.
        image_size: side the model expects; None takes what there is.
        resize: resize frames of another size instead of refusing them.

    Raises:
        DataError: a data set is missing, foreign, truncated or unfinalised; no such camera; wrong or differing frame
            sizes. With a `buffer`, a frame that cannot be decoded is found when it is read.
        OutputError: full disk.
    """
    if isinstance(roots, str | Path):
        roots = [roots] if isinstance(roots, Path) else [name.strip() for name in roots.split(",")]
    sources: list[EpisodeFrames] = []
    for root in [name for name in roots if str(name)] or [""]:
        remote = buffer is not None and is_remote(root)
        files = open_remote(str(root), cache_folder(cache)) if remote else open_files(root)
        labels = labels_of(files)
        limits = limits_of(files, labels["actions"])
        origins = episode_origins(files, labels["actions"], cache_folder(cache))
        views: list[EpisodeFrames] = []
        for one in camera.split(","):
            frames, fingerprint, feature = _frames_of(files, one.strip(), cache, image_size, resize, buffer)
            views.append(
                EpisodeFrames(
                    frames=frames,
                    fingerprint=fingerprint,
                    fps=files.fps,
                    task=next(iter(files.episodes[0].tasks), ""),
                    camera=feature,
                    robot=robot_of(files.info),
                    name=str(root),
                    limits=limits,
                    origins=origins,
                    **labels,
                )
            )
        sources.append(views_of_one(views))
    return concatenate(sources)


def _frames_of(
    files: Contents, camera: str, cache: CachePlace, image_size: int | None, resize: bool, buffer: int | None
) -> tuple[FrameRows, str, str]:
    """A camera's frames, cached or (with a `buffer`) streamed, the data set's fingerprint, and the camera's full
    name."""
    camera, size = files.camera(camera), image_size if resize else None
    stated = stated_size(files.features[camera])
    # Refused before everything is decoded, where the metadata say it.
    if image_size is not None and not resize and stated != (image_size, image_size):
        raise _wrong_size(files, camera, stated, image_size)
    fingerprint = files_fingerprint(files, camera, cache_folder(cache))
    if buffer is not None:
        return FrameStream(files, camera, size, buffer), fingerprint, camera
    make = partial(_frame_cache, files, camera, cache, size, fingerprint)
    folder = make()
    frames: Frames = load_cached(folder, "frames.npy", make)
    if image_size is not None and frames.shape[1:3] != (image_size, image_size):
        raise _wrong_size(files, camera, (frames.shape[1], frames.shape[2]), image_size)
    made_of = json.loads((folder / ENTRY_NAME).read_text()).get("fingerprint", fingerprint)
    if len(frames) != files.rows or made_of != fingerprint:
        raise DataError(
            f"{folder}: got {len(frames)} frames of {made_of}, expected {files.rows} of {fingerprint}: delete it, it "
            "is made again"
        )
    return frames, fingerprint, camera


def _wrong_size(files: Contents, camera: str, got: tuple[int, int], expected: int) -> DataError:
    return DataError(
        f"{files.name}: got frames of {got[0]}x{got[1]} from {camera}, expected {expected}x{expected}: "
        "set env.image_size, resize them by data.resize=true, or record at that size"
    )


def _frame_cache(files: Contents, camera: str, cache: CachePlace, size: int | None, fingerprint: str) -> Path:
    """The cache folder of a data set's camera, made if needed.

    It holds `frames.npy` uint8 (F, H, W, 3) and `meta.json`, and is keyed by the data set's content, the camera and the
    frame size (None keeps it), never by the path.
    """
    folder = cache_folder(cache)
    if folder.resolve().is_relative_to(files.root.resolve()):  # a push would upload it
        raise DataError(
            f"data.cache={folder}: got a folder inside the data set {files.root}, expected one outside: move it"
        )
    key = hashlib.sha256(json.dumps([_FORMAT, fingerprint, camera, size]).encode()).hexdigest()[:24]

    def build(part: Path) -> None:
        array = FrameArray(files, camera, size, part / "frames.npy")
        with room(cache, array.bytes, key):
            array.begin()
        build_frames(files, camera, size, part, settings(cache).workers)
        facts = {"name": str(files.root), "camera": camera, "fingerprint": fingerprint}
        write_json(part / ENTRY_NAME, {**facts, "fps": files.fps, "task": next(iter(files.episodes[0].tasks), "")})

    return build_once(folder / "frames" / key, build)


def labels_of(files: Contents) -> dict[str, Any]:
    """`starts`, `lengths`, `actions`, `states`, `seeds` and `tasks`, as of `EpisodeFrames`."""
    lengths = np.array([episode.length for episode in files.episodes], np.int64)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    actions, states, seeds = map(files.numbers, (keys.FEATURE_ACTION, keys.FEATURE_STATE, keys.FEATURE_SEED))
    return {
        "starts": starts,
        "lengths": lengths,
        "actions": None if actions is None else _fractions(files, keys.FEATURE_ACTION, actions),
        "states": None if states is None else _fractions(files, keys.FEATURE_STATE, states),
        "seeds": None if seeds is None else seeds[starts].astype(np.int64),
        "tasks": np.array([next(iter(episode.tasks), "") for episode in files.episodes], np.str_),
    }


def _fractions(files: Contents, name: str, values: Array) -> npt.NDArray[np.float32]:
    """A feature's values as float32 (F, -1), with a note where whole numbers are too large for it."""
    fractions = values.astype(np.float32)
    if values.dtype.kind in "iu" and (np.abs(values.astype(np.float64)) > 2**24).any():
        say_once(f"note: {files.name}: {name} has whole numbers beyond {2**24}, which float32 rounds")
    return fractions.reshape(files.rows, -1)
