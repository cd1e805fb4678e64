"""Magnified clips: of each clip a square is cut out, the same in all its frames, and enlarged to the frames' size.

    side = round(H / zoom),   corner ~ U{0, ..., H - side}^2,   one for each clip

Things are `zoom` times as large in it, and the ground that frames share fills less of them.

Shapes: B clips, T frames, H H image size.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor


def corners(clips: int, size: int, zoom: float, generator: np.random.Generator) -> npt.NDArray[np.int64]:
    """Upper left corners (B, 2) of the squares, row and column, pixels; `zoom` is 1 or more."""
    return generator.integers(0, size - _side(size, zoom) + 1, (clips, 2))


def magnified(frames: Tensor, zoom: float, at: npt.NDArray[np.int64]) -> Tensor:
    """Clips (B, T, 3, H, H) and corners (B, 2) to magnified clips of the same shape and type (nearest pixel)."""
    size = frames.shape[-1]
    side = _side(size, zoom)
    squares = [clip[..., y : y + side, x : x + side] for clip, (y, x) in zip(frames, at.tolist(), strict=True)]
    large: Tensor = F.interpolate(torch.stack(squares).flatten(0, 1), size=(size, size), mode="nearest")
    magnified: Tensor = large.unflatten(0, frames.shape[:2])
    return magnified


def _side(size: int, zoom: float) -> int:
    return max(1, round(size / zoom))
