"""Between tensors of frames and arrays of pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor


def to_uint8(frames: Tensor) -> npt.NDArray[np.uint8]:
    """(..., 3, H, W) float, about [0, 1] -> (..., H, W, 3) uint8 [0, 255]; values outside are clamped."""
    pixels = frames.detach().clamp(0, 1).mul(255).round().to(torch.uint8)
    array: npt.NDArray[np.uint8] = pixels.movedim(-3, -1).cpu().numpy()
    return array


def to_float(frames: npt.NDArray[np.uint8], device: torch.device | str = "cpu") -> Tensor:
    """(..., H, W, 3) uint8 [0, 255] -> (..., 3, H, W) float32 [0, 1]."""
    return torch.from_numpy(np.array(frames)).to(device).movedim(-1, -3).float().div(255)
