"""Shifted copies of videos: every frame of a copy is moved by the same few pixels, edges are repeated.

Random shifts are the usual augmentation where a policy is cloned from few demonstrations. SAVi reads videos, so a copy
keeps one offset from its first frame to its last, and its slots are parsed and cached like those of any other video.

Shapes: F frames, H W image height and width.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from playslot_rl.data.source import EpisodeFrames, FrameRows, Frames

DIRECTIONS = ((1, 1), (-1, -1), (1, -1), (-1, 1), (1, 0), (-1, 0), (0, 1), (0, -1))
"""Of the copies, (down, right): corners first, so that the first four surround the original."""


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
        height, width = self.shape[1:3]
        down = (np.arange(height) - self.offset[0]).clip(0, height - 1)
        right = (np.arange(width) - self.offset[1]).clip(0, width - 1)
        moved: Frames = np.asarray(self.frames[rows])[..., down[:, None], right[None, :], :]
        return moved


def shifted(source: EpisodeFrames, offset: tuple[int, int]) -> EpisodeFrames:
    """A data set with every frame moved by `offset` pixels (down, right); labels and row numbers are the same."""
    name = f"{source.fingerprint}/shifted {offset[0]} {offset[1]}"
    fingerprint = hashlib.sha256(name.encode()).hexdigest()[:16]
    return replace(source, frames=ShiftedFrames(source.frames, offset), fingerprint=fingerprint)


def shifted_copies(source: EpisodeFrames, shift: int, copies: int) -> Sequence[EpisodeFrames]:
    """The first `copies` of the eight neighbours at `shift` pixels; none where `shift` is 0."""
    return [shifted(source, (shift * y, shift * x)) for y, x in DIRECTIONS[: copies if shift else 0]]


def parsed_views(
    videos: EpisodeFrames,
    first: EpisodeFrames,
    shift: int,
    copies: int,
    parse: Callable[[EpisodeFrames], npt.NDArray[np.float32]],
) -> Sequence[tuple[EpisodeFrames, npt.NDArray[np.float32]]]:
    """Demonstrations and their shifted copies, each with the slots (F, N, D) of its frames.

    Args:
        videos: the data set; parsed whole, so that one cache serves every number of demonstrations.
        first: the demonstrations, the first episodes of it.
        shift: pixels; 0 makes no copies.
        copies: how many.
        parse: gives a data set's slots, such as `slot_cache`.
    """
    return [(first, parse(videos)), *((copy, parse(copy)) for copy in shifted_copies(first, shift, copies))]
