"""Every k-th frame of a data set: videos at 80 frames a second hardly change from one frame to the next.

    row r of episode e  <-  row starts_e + k r,    r = 0 .. ceil(lengths_e / k) - 1

Only these rows are read; the frame cache keeps all, so that another k decodes nothing again. The action of a kept row
is the mean of the k actions that lead to the next kept one (those of a velocity or of a displacement a step stay in
their range).

Shapes: F frames, E episodes, A action width, H W image height and width.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.data.source import EpisodeFrames, FrameRows


@dataclass(frozen=True)
class ChosenFrames:
    """Some rows of others, by their numbers; nothing is copied before it is read.

    Attributes:
        frames: the others.
        rows: int64 (F,), which of them.
    """

    frames: FrameRows
    rows: npt.NDArray[np.int64]

    @property
    def shape(self) -> tuple[int, ...]:
        """(F, H, W, 3)."""
        return (len(self.rows), *self.frames.shape[1:])

    @property
    def dtype(self) -> Any:
        """uint8."""
        return self.frames.dtype

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, rows: Any) -> Any:
        return self.frames[self.rows[rows]]


def every(source: EpisodeFrames, stride: int) -> EpisodeFrames:
    """The same episodes with every `stride`-th of their frames; `stride` 1 gives the data set itself.

    Raises:
        ValueError: `stride` below 1.
    """
    if stride < 1:
        raise ValueError(f"stride: got {stride}, expected 1 (every frame) or more")
    if stride == 1:
        return source
    lengths = -(-source.lengths // stride)
    pairs = zip(source.starts, source.lengths, strict=True)
    rows = np.concatenate([np.arange(s, s + n, stride, dtype=np.int64) for s, n in pairs])
    return replace(
        source,
        frames=ChosenFrames(source.frames, rows),
        starts=(np.cumsum(lengths) - lengths).astype(np.int64),
        lengths=lengths.astype(np.int64),
        actions=None if source.actions is None else _mean_actions(source, stride),
        success=None if source.success is None else source.success[rows],
        fps=source.fps / stride,
        fingerprint=hashlib.sha256(f"{source.fingerprint}/every {stride}".encode()).hexdigest()[:16],
    )


def _mean_actions(source: EpisodeFrames, stride: int) -> npt.NDArray[np.float32]:
    """(F, A) for the kept rows. An episode's last action is padding and counts only where nothing else is left."""
    actions, means = source.require_actions(), []
    for start, length in zip(source.starts, source.lengths, strict=True):
        for first in range(0, int(length), stride):
            last = max(first + 1, min(first + stride, int(length) - 1))
            means.append(actions[start + first : start + last].mean(axis=0))
    return np.stack(means).astype(np.float32)
