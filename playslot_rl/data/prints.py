"""Hashes that tell what a data set holds, and which recording an episode is, whatever set it was copied to: of its
actions, or where these say nothing (none, one alone, NaN) of its pictures.

Merge, split and repair copy rows and packets as they are stored (`playslot_rl.datasets.assemble`). All views of an
episode, of any camera and size, have one origin: its pictures are those of the first camera by name.

Shapes: F rows, E episodes, A action width.
"""

from __future__ import annotations

import bisect
import functools
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.contents import Contents, Span
from playslot_rl.data.frames import rgb_frames
from playslot_rl.data.tables import Array
from playslot_rl.errors import DataError
from playslot_rl.storage.atomic import write_json

_PICTURES: Final = "pictures:"  # versions before named a set and a number instead


def of_pictures(origin: str) -> bool:
    """Whether an origin tells of pictures."""
    return origin.startswith(_PICTURES)


def files_fingerprint(files: Contents, camera: str, cache: Path) -> str:
    """Content hash of a data set."""
    if files.remote is not None:
        return files.remote.fingerprint(camera, files.named_videos(camera))
    return str(_noted(files, camera, cache, lambda: files.file_hash(camera)))


def episode_origins(files: Contents, actions: Array | None, cache: Path) -> npt.NDArray[np.str_] | None:
    """The origin of each episode of a data set with actions (F, A) or without, str (E,); None where one cannot be
    told."""
    ends = np.cumsum([episode.length for episode in files.episodes])
    parts = np.split(np.zeros((files.rows, 0)) if actions is None else actions, ends[:-1])
    said = ["" if bool(((part == part[0]) | np.isnan(part)).all()) else _digest(part.tobytes()) for part in parts]
    if not all(said):
        shown = None
        if files.remote is None and files.cameras:
            camera = min(files.cameras)
            shown = _noted(files, f"pictures of {camera}", cache, lambda: _pictures(files, camera))
        if shown is None:
            return None
        said = [one or _PICTURES + picture for one, picture in zip(said, shown, strict=True)]
    return np.array(said, np.str_)


def _noted(files: Contents, what: str, cache: Path, make: Callable[[], Any]) -> Any:
    """What is made of a data set, remembered by the names, sizes and times of its files: reading videos is slow."""
    key = hashlib.sha256(json.dumps([str(files.root.resolve()), what, files.listing]).encode()).hexdigest()[:32]
    note = cache / "fingerprints" / f"{key}.json"
    if note.is_file():
        return json.loads(note.read_text())["fingerprint"]
    made = make()
    write_json(note, {"fingerprint": made})
    return made


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:12]


def _pictures(files: Contents, camera: str) -> list[str] | None:
    """A hash of each episode's pictures; None where they cannot be read."""
    import av

    try:
        return _of_packets(files, camera) if camera in files.videos else _of_images(files, camera)
    except (DataError, OSError, IndexError, av.FFmpegError):
        return None


def _of_images(files: Contents, camera: str) -> list[str]:
    """Of the first and the last one."""
    ends = [(span.start, span.stop - 1) for span in files.spans]
    spans = [Span(0, row, row + 1, 0) for both in ends for row in both]
    prints = {row: _digest(frame.tobytes()) for row, frame in rgb_frames(files, camera, spans)}
    return [_digest(f"{prints[a]} {prints[b]} {b - a}".encode()) for a, b in ends]


def _of_packets(files: Contents, camera: str) -> list[str] | None:
    """Of the compressed frames of a video: none is decoded."""
    found, half = [], 0.5 / files.fps
    packets = functools.lru_cache(1)(_packets)
    for episode in files.episodes:
        path, times = files.video_file(camera, episode.row), files.video_times(camera, episode.row)
        if path is None or times is None or not files.holds(path):
            return None
        known, begin = packets(path), times[0] - half
        first, last = (bisect.bisect_left(known, (at,)) for at in (begin, begin + episode.length / files.fps))
        if last - first != episode.length:
            return None
        found.append(_digest(" ".join(picture for _, picture in known[first:last]).encode()))
    return found


def _packets(path: Path) -> list[tuple[float, str]]:
    """Time, seconds, and hash of each packet of a video, in the order of their times."""
    import av

    with av.open(str(path)) as container:
        stream: Any = container.streams.video[0]
        packets = [packet for packet in container.demux(stream) if packet.size]
        found = [(float((packet.pts or 0) * stream.time_base), _digest(bytes(packet))) for packet in packets]
    return sorted(found)
