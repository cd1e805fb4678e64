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
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from playslot_rl.data.contents import PLACE, Array, Contents, Span, read_contents
from playslot_rl.data.problems import Problems
from playslot_rl.datasets.frames import CameraScan, scan_frames
from playslot_rl.errors import DataError

DIGITS = 32


@dataclass(frozen=True)
class Fingerprint:
    """Of a data set.

    Attributes:
        value: of all of it, 32 hex digits.
        episodes: of each episode, in order.
    """

    value: str
    episodes: tuple[str, ...]


def content_fingerprint(root: str | Path) -> Fingerprint:
    """Fingerprint of the data set at `root`; decodes all its frames.

    Raises:
        DataError: something cannot be read.
    """
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
