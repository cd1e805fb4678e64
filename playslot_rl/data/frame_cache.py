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
from playslot_rl.data.contents import Contents
from playslot_rl.data.frames import rgb_frames
from playslot_rl.errors import DataError
from playslot_rl.storage.atomic import write_json

_FORMAT = "1"


def cached_fingerprint(files: Contents, camera: str, cache: Path) -> str:
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
    fingerprint = files.file_hash(camera)
    write_json(note, {"fingerprint": fingerprint})
    return fingerprint


def frame_cache(files: Contents, camera: str, cache: str | Path, size: int | None) -> tuple[Path, str]:
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


def _build(files: Contents, camera: str, size: int | None, folder: Path) -> None:
    writer: ArrayWriter | None = None
    for row, frame in rgb_frames(files, camera):
        pixels = frame if size is None or frame.shape[:2] == (size, size) else resize_frames(frame[None], size)[0]
        if writer is None:
            writer = ArrayWriter(folder / "frames.npy", (files.rows, *pixels.shape), np.uint8)
        writer.write(pixels[None], row)
    if writer is None:
        raise DataError(f"{files.root}: got no frames of {camera}, expected {files.rows}: collect or pull it again")
    writer.close()
    np.savez(folder / "columns.npz", **_columns(files))  # type: ignore[arg-type]
    tasks = files.episodes[0].tasks
    write_json(folder / "meta.json", {"camera": camera, "fps": files.fps, "task": tasks[0] if tasks else ""})


def resize_frames(frames: npt.NDArray[np.uint8], size: int) -> npt.NDArray[np.uint8]:
    """Resize whole frames by area averaging: uint8 (n, H, W, 3) to (n, size, size, 3)."""
    from PIL import Image

    resized = [np.asarray(Image.fromarray(f).resize((size, size), Image.Resampling.BOX)) for f in frames]
    return np.stack(resized)


def _columns(files: Contents) -> dict[str, npt.NDArray[Any]]:
    lengths = np.array([episode.length for episode in files.episodes], np.int64)
    starts = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int64)
    found: dict[str, npt.NDArray[Any]] = {"starts": starts, "lengths": lengths}
    if keys.FEATURE_ACTION in files.columns:
        found["actions"] = files.columns[keys.FEATURE_ACTION].astype(np.float32).reshape(files.rows, -1)
    if keys.FEATURE_SUCCESS in files.columns:
        found["success"] = files.columns[keys.FEATURE_SUCCESS].astype(bool)
    if keys.FEATURE_SEED in files.columns:
        found["seeds"] = files.columns[keys.FEATURE_SEED][starts].astype(np.int64)
    return found
