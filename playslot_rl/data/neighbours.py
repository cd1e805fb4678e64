"""Rows beside rows: the frames before and after one, inside its episode, and rows some at a time.

Shapes: F rows (frames) of a data set, M rows that are asked for.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import IntArray


class Ends(NamedTuple):
    """Rows of the first and of the last frame of the episode that each row belongs to, int64 (F,); -1 where none."""

    first: IntArray
    last: IntArray

    @classmethod
    def of(cls, source: EpisodeFrames) -> Ends:
        first, last = np.full((2, len(source.frames)), -1, np.int64)
        for start, length in zip(source.starts, source.lengths, strict=True):
            first[start : start + length], last[start : start + length] = start, start + length - 1
        return cls(first, last)

    def past(self, rows: IntArray, frames: int) -> IntArray:
        """Rows (..., `frames`) that end in each (...); before an episode's first frame it stands again.

        Example:
            >>> Ends(np.array([0, 0, 0]), np.array([2, 2, 2])).past(np.array([1, 2]), 3)
            array([[0, 0, 1],
                   [0, 1, 2]])
        """
        past: IntArray = np.maximum(rows[..., None] + np.arange(1 - frames, 1), self.first[rows][..., None])
        return past

    def ahead(self, rows: IntArray, most: int, numbers: np.random.Generator) -> IntArray:
        """A row 1 to `most` steps after each of `rows` (...), which are no last ones, uniformly within its episode."""
        reach = np.minimum(most, self.last[rows] - rows)
        ahead: IntArray = rows + 1 + (numbers.random(rows.shape) * reach).astype(np.int64)
        return ahead


def pairs_at(rows: IntArray) -> IntArray:
    """Rows (M, 2): each of `rows` (M,), which are no last ones of their episodes, and the next."""
    return np.stack((rows, rows + 1), axis=1)


def in_batches(rows: IntArray, most: int = 64) -> list[IntArray]:
    """The rows in equal parts, or nearly so, of at most `most`."""
    return np.array_split(rows, -(-len(rows) // most))
