"""Frames by row number, and views of them: nothing is copied or computed before it is read.

    view[i] = moved(joined[rows_i]),   joined: the parts, one after the other

Shapes: F rows, H W image height and width, C channels.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Frames = npt.NDArray[np.uint8]
IntArray = npt.NDArray[np.int64]


class FrameRows(Protocol):
    """Rows (F, ...), uint8 (F, H, W, 3) of frames; an array, or something that reads like one."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> Any: ...

    def __len__(self) -> int: ...

    def __getitem__(self, rows: Any, /) -> Any:
        """Rows by an integer, a slice or an integer array of any shape."""


def row_numbers(rows: Any, count: int) -> tuple[IntArray, tuple[int, ...]]:
    """The rows that an index means, int64 (n,) from 0 on, and its shape: an integer, a slice or an integer array of any
    shape, in which negative numbers count from the end. An IndexError where there is no such row."""
    if isinstance(rows, slice):
        rows = np.arange(*rows.indices(count))
    index = np.asarray(rows, np.int64)
    flat = np.where(index < 0, index + count, index).reshape(-1)
    if flat.size and (flat.min() < 0 or flat.max() >= count):
        raise IndexError(f"row {int(flat.max())}: expected 0 to {count - 1}")
    return flat, index.shape


def shift_frames(frames: Frames, offsets: npt.ArrayLike) -> Frames:
    """Frames (..., H, W, C) moved by pixels (down, right), by offsets (2,) or each by its own (..., 2); edges repeat.

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


@dataclass(frozen=True, eq=False)
class RowView:
    """Rows of other rows: several in a row as one, some of them, or all of them moved.

    Attributes:
        parts: one after the other along the first axis.
        rows: int64 (F,), which rows of the parts; None takes all.
        offset: pixels (down, right) that every frame is moved by.

    Example:
        >>> frames = np.arange(8, dtype=np.uint8).reshape(2, 2, 2, 1)
        >>> RowView((frames, frames), rows=np.array([3]), offset=(0, 1))[0, ..., 0].tolist()
        [[4, 4], [6, 6]]
    """

    parts: Sequence[FrameRows]
    rows: IntArray | None = None
    offset: tuple[int, int] = (0, 0)

    @cached_property
    def shape(self) -> tuple[int, ...]:
        """(F, ...)."""
        return (int(self._ends[-1]) if self.rows is None else len(self.rows), *self.parts[0].shape[1:])

    @property
    def dtype(self) -> Any:
        return self.parts[0].dtype

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: Any) -> Any:
        """Rows by an integer, a slice or an integer array of any shape."""
        if len(self.parts) == 1:
            found = np.asarray(self.parts[0][rows if self.rows is None else self.rows[rows]])
        else:
            flat, shape = row_numbers(rows, len(self))
            found = np.empty((len(flat), *self.shape[1:]), self.dtype)
            for part, here, own in self.located(flat):
                if len(own):
                    found[here] = part[own]
            found = found.reshape(*shape, *self.shape[1:])
        return shift_frames(found, self.offset) if any(self.offset) else found

    def located(self, rows: IntArray) -> Iterator[tuple[FrameRows, npt.NDArray[np.bool_], IntArray]]:
        """Each part, which of the rows (n,), numbers from 0 on, are in it, bool (n,), and their numbers there."""
        rows = rows if self.rows is None else self.rows[rows]
        number = np.searchsorted(self._ends, rows, side="right")
        for i, part in enumerate(self.parts):
            here = number == i
            yield part, here, rows[here] - (int(self._ends[i]) - len(part))

    @cached_property
    def _ends(self) -> IntArray:
        """The row after each part's last one."""
        return np.cumsum([len(part) for part in self.parts])
