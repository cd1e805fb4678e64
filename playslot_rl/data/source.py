"""Opening data sets for training: decoded frames by row number, whatever LeRobot v3.0 data set they come from.

A data set is decoded once, into the frame cache: an uncompressed, memory-mapped uint8 array.

Shapes: F frames, E episodes, H W image height and width, A action width.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.data.action_limits import ActionLimits, joined_limits, limits_of
from playslot_rl.data.agreement import open_files
from playslot_rl.data.cache import CachePlace, build_on, cache_folder, load_cached, note_read, settings
from playslot_rl.data.cache_entries import ENTRY_NAME, room
from playslot_rl.data.contents import Contents
from playslot_rl.data.frame_build import FrameArray, build_frames
from playslot_rl.data.metadata import stated_size
from playslot_rl.errors import DataError
from playslot_rl.storage.atomic import write_json

if TYPE_CHECKING:
    from torch import Tensor

    from playslot_rl.data.weighted import Shares

Frames = npt.NDArray[np.uint8]
_FORMAT = "1"
"""Of the frame cache."""


class FrameRows(Protocol):
    """Frames uint8 (F, H, W, 3) by row number: an array, several in a row, or one that computes what it reads."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(F, H, W, 3)."""

    @property
    def dtype(self) -> Any:
        """uint8."""

    def __len__(self) -> int:
        """F."""

    def __getitem__(self, rows: Any, /) -> Any:
        """Frames of an integer, a slice or an integer array of any shape."""


def row_numbers(rows: Any, count: int) -> tuple[npt.NDArray[np.int64], tuple[int, ...]]:
    """The rows that an index means.

    Args:
        rows: an integer, a slice or an integer array of any shape; negative numbers count from the end.
        count: of all rows.

    Returns:
        Numbers from 0 on, int64 (n,), and the shape of the index.

    Raises:
        IndexError: there is no such row.
    """
    if isinstance(rows, slice):
        rows = np.arange(*rows.indices(count))
    index = np.asarray(rows, np.int64)
    flat = np.where(index < 0, index + count, index).reshape(-1)
    if flat.size and (flat.min() < 0 or flat.max() >= count):
        raise IndexError(f"row {int(flat.max())}: expected 0 to {count - 1}")
    return flat, index.shape


class ConcatFrames:
    """Several memory-mapped arrays as one along the first axis, gathered by row numbers; nothing is copied before."""

    def __init__(self, parts: Sequence[FrameRows]) -> None:
        self.parts = list(parts)
        self._ends = np.cumsum([len(part) for part in self.parts])
        self.shape = (int(self._ends[-1]), *self.parts[0].shape[1:])
        self.dtype = self.parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> Frames:
        """Rows by an integer, a slice or an integer array of any shape."""
        flat, shape = row_numbers(rows, len(self))
        part = np.searchsorted(self._ends, flat, side="right")
        out = np.empty((len(flat), *self.shape[1:]), self.dtype)
        for number in np.unique(part):
            here = part == number
            offset = self._ends[number] - len(self.parts[number])
            out[here] = self.parts[number][flat[here] - offset]
        return out.reshape(*shape, *self.shape[1:])


@dataclass(frozen=True)
class EpisodeFrames:
    """A data set's frames and labels by row. Episode e is rows `starts[e]` to `starts[e] + lengths[e]`.

    An episode of n rows has n - 1 transitions: row t and row t + 1 with the action of row t. The action of an episode's
    last row is padding.

    Attributes:
        frames: uint8 (F, H, W, 3), [0, 255], memory-mapped; index it by integers, slices or integer arrays.
        starts, lengths: int64 (E,).
        actions: float32 (F, A), as they were recorded, or None if the data set (or one of several) has none.
        success: bool (F,), or None.
        seeds: int64 (E,), or None.
        fingerprint: content hash, 16 hex digits.
        fps: frames a second.
        task: the task in words.
        camera: feature the frames come from.
        robot: what was recorded, as the data set says; empty where it says nothing.
        name: the folder it was read from, for people.
        shares: of several sets that are drawn from with weights, which rows are whose; None draws all windows alike.
        limits: what actions in [-1, 1] stand for; None for those of our simulators, which are so, and without actions.
    """

    frames: FrameRows
    starts: npt.NDArray[np.int64]
    lengths: npt.NDArray[np.int64]
    actions: npt.NDArray[np.float32] | None
    success: npt.NDArray[np.bool_] | None
    seeds: npt.NDArray[np.int64] | None
    fingerprint: str
    fps: float
    task: str
    camera: str
    robot: str = ""
    name: str = ""
    shares: Shares | None = None
    limits: ActionLimits | None = None

    @property
    def episodes(self) -> int:
        """E."""
        return len(self.starts)

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
        """Row numbers of an episode."""
        return np.arange(self.starts[episode], self.starts[episode] + self.lengths[episode])

    def require_actions(self, width: int | None = None) -> npt.NDArray[np.float32]:
        """The actions.

        Args:
            width: A; None takes what there is.

        Raises:
            DataError: the data set has none, or of another width.
        """
        if self.actions is None:
            raise DataError(
                "got a data set without actions, expected the feature `action`: use labelled demonstrations"
            )
        if width is not None and self.actions.shape[1] != width:
            raise DataError(
                f"got actions of width {self.actions.shape[1]}, expected {width} as in env.action_dim: "
                "use a data set of this robot, or set env.action_dim when the world model is trained"
            )
        return self.actions


def open_source(
    root: str | Path, camera: str = "", cache: CachePlace = "", *, image_size: int | None = None, resize: bool = False
) -> EpisodeFrames:
    """Open a LeRobot v3.0 data set through the frame cache; the first time decodes all its frames.

    Args:
        root: its folder.
        camera: image or video feature; empty means the only one.
        cache: the cache; empty means `$PLAYSLOT_CACHE` or `~/.cache/playslot_rl`.
        image_size: side the model expects; None takes what there is.
        resize: resize frames of another size instead of refusing them.

    Raises:
        DataError: the data set is missing, foreign, truncated or unfinalised; no such camera; wrong frame size.
        OutputError: full disk.
    """
    files = open_files(root)
    camera = files.camera(camera)
    stated = stated_size(files.features[camera])
    # Refused before everything is decoded, where the metadata say it.
    if image_size is not None and not resize and stated != (image_size, image_size):
        raise wrong_size(files, camera, stated, image_size)
    make = partial(_frame_cache, files, camera, cache, image_size if resize else None)
    folder, fingerprint = make()
    frames: Frames = load_cached(folder, "frames.npy", make)
    if image_size is not None and frames.shape[1:3] != (image_size, image_size):
        raise wrong_size(files, camera, (frames.shape[1], frames.shape[2]), image_size)
    meta = json.loads((folder / ENTRY_NAME).read_text())
    if len(frames) != files.rows or meta.get("fingerprint", fingerprint) != fingerprint:
        raise DataError(
            f"{folder}: got {len(frames)} frames of {meta.get('fingerprint')}, expected {files.rows} of {fingerprint}: "
            "delete it, it is made again"
        )
    with np.load(folder / "columns.npz") as columns:
        labels: dict[str, Any] = {
            name: columns.get(name) for name in ("starts", "lengths", "actions", "success", "seeds")
        }
    return EpisodeFrames(
        frames=frames,
        fingerprint=fingerprint,
        fps=meta["fps"],
        task=meta["task"],
        camera=camera,
        robot=str(files.info.get("robot_type") or ""),
        name=str(root),
        limits=limits_of(files, labels["actions"]),
        **labels,
    )


def open_sources(
    roots: str | Sequence[str | Path],
    camera: str = "",
    cache: CachePlace = "",
    *,
    image_size: int | None = None,
    resize: bool = False,
    buffer: int | None = None,
) -> EpisodeFrames:
    """Open one or several data sets as one; `roots` is a list, or a string with commas.

    With several cameras (commas in `camera`) each episode comes once for each of them. Labels that not every data set
    has are dropped. The frames must have one size. With a `buffer`, frames of a shuffle buffer, they are not cached but
    decoded while they are read (`playslot_rl.data.stream`).

    Raises:
        DataError: as `open_source`, or the frame sizes differ.
    """
    names = [name.strip() for name in roots.split(",")] if isinstance(roots, str) else list(roots)
    cameras = [name.strip() for name in camera.split(",")]
    pairs = [(name, one) for name in ([name for name in names if str(name)] or [""]) for one in cameras]
    names = [name for name, _ in pairs]
    if buffer is None:
        opening = partial(open_source, image_size=image_size, resize=resize)
    else:
        from playslot_rl.data.stream import open_stream

        opening = partial(open_stream, image_size=image_size, resize=resize, buffer=buffer)
    sources = [opening(root, one, cache) for root, one in pairs]
    if len(sources) == 1:
        return sources[0]
    for name, source in zip(names, sources, strict=True):
        if source.image_size != sources[0].image_size:
            got, want = source.image_size, sources[0].image_size
            raise DataError(f"{name}: got frames of {got[0]}x{got[1]}, expected {want[0]}x{want[1]} as in {names[0]}")
    return concatenate(sources)


def concatenate(sources: Sequence[EpisodeFrames]) -> EpisodeFrames:
    """Several data sets with frames of one size as one; labels that not all have, or of another width, are dropped."""
    offsets = np.cumsum([0, *(len(source.frames) for source in sources)])[:-1]
    parts = [p for s in sources for p in (s.frames.parts if isinstance(s.frames, ConcatFrames) else [s.frames])]

    def joined(name: str) -> Any:
        labels = [getattr(source, name) for source in sources]
        if any(label is None or label.shape[1:] != labels[0].shape[1:] for label in labels):
            return None
        return np.concatenate(labels)

    actions = joined("actions")
    return replace(
        sources[0],
        frames=ConcatFrames(parts),
        starts=np.concatenate([s.starts + offset for s, offset in zip(sources, offsets, strict=True)]),
        lengths=np.concatenate([s.lengths for s in sources]),
        actions=actions,
        success=joined("success"),
        seeds=joined("seeds"),
        fingerprint=hashlib.sha256("+".join(s.fingerprint for s in sources).encode()).hexdigest()[:16],
        name=",".join(dict.fromkeys(s.name for s in sources)),
        shares=None,
        limits=None if actions is None else joined_limits([s.limits for s in sources], actions.shape[1]),
    )


def wrong_size(files: Contents, camera: str, got: tuple[int, int], expected: int) -> DataError:
    """Frames of another size than the model's."""
    return DataError(
        f"{files.name}: got frames of {got[0]}x{got[1]} from {camera}, expected {expected}x{expected}: "
        "set env.image_size, resize them by data.resize=true, or record at that size"
    )


def _frame_cache(files: Contents, camera: str, cache: CachePlace, size: int | None) -> tuple[Path, str]:
    """The cache folder of a data set's camera, made if needed, and the data set's fingerprint.

    It holds `frames.npy` uint8 (F, H, W, 3), `columns.npz` and `meta.json`, and is keyed by the data set's content, the
    camera and the frame size (None keeps it), never by the path.
    """
    folder = cache_folder(cache)
    if folder.resolve().is_relative_to(files.root.resolve()):  # a push would upload it
        raise DataError(
            f"data.cache={folder}: got a folder inside the data set {files.root}, expected one outside: move it"
        )
    fingerprint = files_fingerprint(files, camera, folder)
    key = hashlib.sha256(json.dumps([_FORMAT, fingerprint, camera, size]).encode()).hexdigest()[:24]

    def build(part: Path) -> None:
        array = FrameArray(files, camera, size, part / "frames.npy")
        with room(cache, array.bytes, key):
            array.begin()
        build_frames(files, camera, size, part, settings(cache).workers)
        np.savez(part / "columns.npz", **labels_of(files))  # type: ignore[arg-type]
        tasks = files.episodes[0].tasks
        facts = {"name": str(files.root), "camera": camera, "fingerprint": fingerprint}
        write_json(part / ENTRY_NAME, {**facts, "fps": files.fps, "task": tasks[0] if tasks else ""})

    return build_on(folder / "frames" / key, build), fingerprint


def files_fingerprint(files: Contents, camera: str, cache: Path) -> str:
    """Content hash of a data set, remembered by the names, sizes and times of its files: hashing videos is slow."""
    if files.remote is not None:
        return files.remote.fingerprint(camera)
    listing = sorted(
        (str(path.relative_to(files.root)), path.stat().st_size, path.stat().st_mtime_ns)
        for folder in ("meta", "data", "videos")
        for path in (files.root / folder).rglob("*")
        if path.is_file()
    )
    key = hashlib.sha256(json.dumps([str(files.root.resolve()), camera, listing]).encode()).hexdigest()[:32]
    note = cache / "fingerprints" / f"{key}.json"
    if note.is_file():
        return str(json.loads(note.read_text())["fingerprint"])
    fingerprint = files.file_hash(camera)
    write_json(note, {"fingerprint": fingerprint})
    return fingerprint


def labels_of(files: Contents) -> dict[str, npt.NDArray[Any]]:
    """`starts`, `lengths`, and where there are some, `actions`, `success` and `seeds`, as of `EpisodeFrames`."""
    lengths = np.array([episode.length for episode in files.episodes], np.int64)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    found: dict[str, npt.NDArray[Any]] = {"starts": starts, "lengths": lengths}
    actions, success, seeds = map(files.numbers, (keys.FEATURE_ACTION, keys.FEATURE_SUCCESS, keys.FEATURE_SEED))
    if actions is not None:
        found["actions"] = actions.astype(np.float32).reshape(files.rows, -1)
    if success is not None:
        found["success"] = success.astype(bool)
    if seeds is not None:
        found["seeds"] = seeds[starts].astype(np.int64)
    return found
