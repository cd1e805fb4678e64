"""Shifted copies of videos: every frame of a copy is moved by the same few pixels, edges are repeated.

The usual augmentation where a policy is cloned from few demonstrations. SAVi reads videos, so a copy keeps one offset
from its first frame to its last, and its slots are parsed and cached like those of any other video.

Shapes: F frames, H W image height and width.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.data.source import EpisodeFrames, FrameRows, Frames

DIRECTIONS = ((1, 1), (-1, -1), (1, -1), (-1, 1), (1, 0), (-1, 0), (0, 1), (0, -1))
"""Of the copies, (down, right): corners first, so that the first four surround the original."""


def shift_frames(frames: Frames, offsets: npt.ArrayLike) -> Frames:
    """Frames (..., H, W, C) moved by pixels (down, right), all by offsets (2,) or each by its own (..., 2).

    Content that enters repeats the edge.

    Example:
        >>> frames = np.arange(4, dtype=np.uint8).reshape(1, 2, 2, 1)
        >>> shift_frames(frames, [[0, 1]])[0, ..., 0].tolist()
        [[0, 0], [2, 2]]
    """
    height, width = frames.shape[-3:-1]
    flat = frames.reshape(-1, *frames.shape[-3:])
    moves = np.broadcast_to(np.asarray(offsets).reshape(-1, 2), (len(flat), 2))
    down = (np.arange(height) - moves[:, :1]).clip(0, height - 1)
    right = (np.arange(width) - moves[:, 1:]).clip(0, width - 1)
    moved: Frames = flat[np.arange(len(flat))[:, None, None], down[:, :, None], right[:, None, :]]
    return moved.reshape(frames.shape)


@dataclass(frozen=True)
class ShiftedFrames:
    """Frames (F, H, W, 3) moved by an offset, computed when they are read.

    Attributes:
        frames: uint8, memory-mapped.
        offset: pixels (down, right); content that enters repeats the edge.

    Example:
        >>> frames = np.arange(4, dtype=np.uint8).reshape(1, 2, 2, 1)
        >>> ShiftedFrames(frames, (0, 1))[0, ..., 0].tolist()
        [[0, 0], [2, 2]]
    """

    frames: FrameRows
    offset: tuple[int, int]

    @property
    def shape(self) -> tuple[int, ...]:
        """(F, H, W, 3)."""
        return tuple(self.frames.shape)

    @property
    def dtype(self) -> Any:
        """uint8."""
        return self.frames.dtype

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, rows: Any) -> Frames:
        """Rows by an integer, a slice or an integer array of any shape."""
        return shift_frames(np.asarray(self.frames[rows]), self.offset)


def shifted(source: EpisodeFrames, offset: tuple[int, int]) -> EpisodeFrames:
    """A data set with every frame moved by `offset` pixels (down, right); labels and row numbers are the same."""
    name = f"{source.fingerprint}/shifted {offset[0]} {offset[1]}"
    fingerprint = hashlib.sha256(name.encode()).hexdigest()[:16]
    return replace(source, frames=ShiftedFrames(source.frames, offset), fingerprint=fingerprint)


def shifted_copies(source: EpisodeFrames, shift: int, copies: int) -> Sequence[EpisodeFrames]:
    """The first `copies` of the eight neighbours at `shift` pixels; none where `shift` is 0."""
    return [shifted(source, (shift * y, shift * x)) for y, x in DIRECTIONS[: copies if shift else 0]]
