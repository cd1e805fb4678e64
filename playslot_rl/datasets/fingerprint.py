"""A fingerprint of what a data set says, not of how it is stored.

It covers, for each episode in order: its length, its tasks in words, every value of every feature, and every frame as
decoded pixels (images) or decoded planes (videos); and the data set's rate and the names, types and shapes of its
features. It does not cover statistics, the sizes and number of files, compression, or a row's place (`index`,
`episode_index`, `task_index`). So it stays the same when shards are merged anew or metadata are rewritten, and an
episode keeps its own when data sets are merged or split. Encoding a video again changes it, as its frames change.

Note: `playslot_rl.data.contents.Contents.file_hash` is another one: a hash of the files' bytes, quick to
compute and the key of the caches.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from playslot_rl.data.contents import Contents, Span, read_contents
from playslot_rl.data.frames import Decoded, decoded_frames, to_rgb
from playslot_rl.data.metadata import PLACE, is_depth
from playslot_rl.data.places import Problems
from playslot_rl.data.tables import Array
from playslot_rl.datasets.statistics import of_frames, rounded, sampled, thinned
from playslot_rl.errors import DataError

DIGITS = 32


@dataclass(frozen=True)
class Fingerprint:
    """Of a data set."""

    value: str
    episodes: tuple[str, ...]


def content_fingerprint(root: str | Path) -> Fingerprint:
    """Fingerprint of the data set at `root`; decodes all its frames. A DataError where something cannot be read."""
    problems = Problems()
    contents = read_contents(root, problems)
    scans = scan_frames(contents, problems)
    if problems.errors:
        raise DataError(f"{problems.errors[0]}; run `playslot dataset verify {root}`")
    return fingerprint_of(contents, scans)


def fingerprint_of(contents: Contents, scans: Mapping[str, CameraScan]) -> Fingerprint:
    """Fingerprint of what has been read; frames that could not be decoded count as empty."""
    features = {name: [f["dtype"], [int(n) for n in f["shape"]]] for name, f in sorted(contents.features.items())}
    digest = hashlib.sha256(json.dumps([contents.fps, features], sort_keys=True).encode())
    episodes = tuple(_episode(contents, scans, span) for span in contents.spans)
    for episode in episodes:
        digest.update(bytes.fromhex(episode))
    return Fingerprint(digest.hexdigest()[:DIGITS], episodes)


def _episode(contents: Contents, scans: Mapping[str, CameraScan], span: Span) -> str:
    rows = slice(span.start, span.stop)
    tasks = [contents.tasks.get(int(n), "") for n in contents.columns["task_index"][rows]]
    digest = hashlib.sha256(json.dumps([span.length, tasks]).encode())
    for name in sorted(contents.features):
        if name in PLACE:
            continue
        digest.update(f"\0{name}\0".encode())
        if name in scans:
            for frame in scans[name].digests[rows]:
                digest.update(frame)
        elif name in contents.columns:
            digest.update(_bytes(contents.columns[name][rows]))
    return digest.hexdigest()[:DIGITS]


def _bytes(values: Array) -> bytes:
    if values.dtype == object:
        return json.dumps(values.tolist(), sort_keys=True, default=str).encode()
    little = np.ascontiguousarray(values.astype(values.dtype.newbyteorder("<"), copy=False))
    return f"{little.dtype.str} {little.shape} ".encode() + little.tobytes()


@dataclass
class CameraScan:
    """One camera's frames: `digests` of the decoded pixels of each row (F), empty where one cannot be decoded, and
    `stats` of each span, from the frames that LeRobot would sample (None for depth maps and damaged episodes); `theirs`
    with LeRobot's rounding of mean and standard deviation."""

    digests: list[bytes]
    stats: list[dict[str, Array] | None] = field(default_factory=list)
    theirs: list[dict[str, Array] | None] = field(default_factory=list)


def scan_frames(contents: Contents, problems: Problems) -> dict[str, CameraScan]:
    """Decode all frames of all cameras; what cannot be decoded, or has another size, is noted in `problems`."""
    return {camera: _scan(contents, camera, problems) for camera in contents.cameras}


def _scan(contents: Contents, camera: str, problems: Problems) -> CameraScan:
    spans = contents.spans
    scan = CameraScan([b""] * contents.rows, [None] * len(spans), [None] * len(spans))
    depth = is_depth(contents.features[camera])
    wanted = {span.start + i: number for number, span in enumerate(spans) for i in sampled(span.length)}
    kept: dict[int, list[npt.NDArray[np.uint8]]] = {}
    for row, frame in decoded_frames(contents, camera, problems):
        planes = _planes(frame)
        header = f"{planes.dtype.str} {planes.shape} ".encode()
        scan.digests[row] = hashlib.sha256(header + np.ascontiguousarray(planes).tobytes()).digest()
        number = wanted.get(row)
        if number is None or depth or (frame is planes and planes.ndim < 3):
            continue
        kept.setdefault(number, []).append(thinned(to_rgb(frame)))
        if len(kept[number]) == len(sampled(spans[number].length)):
            taken = kept.pop(number)
            exact = scan.stats[number] = of_frames(taken)
            scan.theirs[number] = exact | {
                name: value.reshape(-1, 1, 1) / 255.0
                for name, value in rounded(pixels.reshape(-1, pixels.shape[-1]) for pixels in taken).items()
            }
    return scan


def _planes(frame: Decoded) -> Array:
    """A frame as the decoder made it: a video's conversion to RGB may differ between builds of FFmpeg."""
    if isinstance(frame, np.ndarray):
        return frame
    try:
        planes: Array = frame.to_ndarray()
    except ValueError:  # a pixel format that PyAV cannot hand over
        planes = frame.to_ndarray(format="rgb24")
    return planes
