"""The frame cache: a data set decoded once into an uncompressed, memory-mapped uint8 array.

Keyed by the data set's content, the camera and the frame size, never by its path.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl import keys
from playslot_rl.data.cache import ArrayWriter, build_once, cache_folder, require_outside
from playslot_rl.data.lerobot_files import LeRobotFiles
from playslot_rl.errors import DataError
from playslot_rl.storage.atomic import write_json

_FORMAT = "1"


def cached_fingerprint(files: LeRobotFiles, camera: str, cache: Path) -> str:
    """Content hash of a data set, remembered by the names, sizes and times of its files: hashing videos is slow."""
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
    fingerprint = files.fingerprint(camera)
    write_json(note, {"fingerprint": fingerprint})
    return fingerprint


def frame_cache(files: LeRobotFiles, camera: str, cache: str | Path, size: int | None) -> tuple[Path, str]:
    """The cache folder of a data set's camera, made if needed, and the data set's fingerprint.

    It holds `frames.npy` uint8 (F, H, W, 3), `columns.npz` and `meta.json`.

    Args:
        files: the data set.
        camera: image or video feature.
        cache: the cache; empty means the default one.
        size: side to resize the frames to; None keeps them.

    Raises:
        DataError: the cache lies inside the data set, or a frame cannot be decoded.
        OutputError: full disk.
    """
    folder = cache_folder(cache)
    require_outside(folder, files.root)
    fingerprint = cached_fingerprint(files, camera, folder)
    key = hashlib.sha256(json.dumps([_FORMAT, fingerprint, camera, size]).encode()).hexdigest()[:24]
    return build_once(folder / "frames" / key, lambda tmp: _build(files, camera, size, tmp)), fingerprint


def _build(files: LeRobotFiles, camera: str, size: int | None, folder: Path) -> None:
    writer: ArrayWriter | None = None
    for piece in files.pieces(camera):
        frames = piece if size is None or piece.shape[1:3] == (size, size) else resize_frames(piece, size)
        if writer is None:
            writer = ArrayWriter(folder / "frames.npy", (files.frames, *frames.shape[1:]), np.uint8)
        if frames.shape[1:] != writer.shape[1:]:
            raise DataError(
                f"{files.root}: got frames of {frames.shape[1:3]} after ones of {writer.shape[1:3]}, expected one "
                "size: the data set is damaged, collect or pull it again"
            )
        writer.write(frames)
    if writer is None:
        raise DataError(f"{files.root}: got no frames of {camera}, expected {files.frames}: collect or pull it again")
    writer.close()
    np.savez(folder / "columns.npz", **_columns(files))  # type: ignore[arg-type]
    write_json(folder / "meta.json", {"camera": camera, "fps": files.fps, "task": files.task})


def resize_frames(frames: npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    """Resize whole frames by area averaging: uint8 (n, H, W, 3) to (n, size, size, 3)."""
    from PIL import Image

    resized = [np.asarray(Image.fromarray(f).resize((size, size), Image.Resampling.BOX)) for f in frames]
    return np.stack(resized)


def _columns(files: LeRobotFiles) -> dict[str, npt.NDArray[Any]]:
    lengths = np.array([row["length"] for row in files.episodes], np.int64)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    columns: dict[str, npt.NDArray[Any]] = {"starts": starts, "lengths": lengths}
    actions, success = files.column(keys.FEATURE_ACTION), files.column(keys.FEATURE_SUCCESS)
    seeds = files.column(keys.FEATURE_SEED)
    if actions is not None:
        columns["actions"] = actions.astype(np.float32).reshape(files.frames, -1)
    if success is not None:
        columns["success"] = success.astype(bool)
    if seeds is not None:
        columns["seeds"] = seeds[starts].astype(np.int64)
    return columns
