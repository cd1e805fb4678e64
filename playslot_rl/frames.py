"""Frames as bytes and as numbers: the only place where one becomes the other.

Shapes: H W frame height and width. Bytes are uint8 [0, 255], numbers float [0, 1].
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

if TYPE_CHECKING:
    from PIL import Image

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of ImageNet's frames, with which torchvision's weights were trained."""


def normalise(pixels: Tensor) -> Tensor:
    """uint8 [0, 255] to float32 [0, 1], of any shape; floats pass through."""
    return pixels if pixels.is_floating_point() else pixels.float().div_(255)


def quantise(pixels: Tensor) -> Tensor:
    """Floats of about [0, 1] to the nearest uint8 [0, 255], of any shape; values outside are clamped, bytes pass."""
    return pixels if pixels.dtype == torch.uint8 else pixels.detach().clamp(0, 1).mul(255).round().to(torch.uint8)


def psnr(mse: Tensor) -> Tensor:
    """Peak signal-to-noise ratio (dB) of mean squared errors on frames in [0, 1], of any shape.

    1e-8 is added to each, as the authors do: equal frames have 80 dB.
    """
    return -10 * (mse + 1e-8).log10()


def png(picture: Image.Image | npt.NDArray[np.uint8], level: int = 6) -> bytes:
    """A picture (H, W, 3) as the content of a PNG file; compression 6 is that of LeRobot, 1 is quick."""
    from PIL import Image

    buffer = io.BytesIO()
    image = Image.fromarray(picture) if isinstance(picture, np.ndarray) else picture
    image.save(buffer, format="PNG", compress_level=level)
    return buffer.getvalue()


def to_float(frames: npt.NDArray[np.uint8], device: torch.device | str = "cpu") -> Tensor:
    """Pictures (..., H, W, 3) uint8 to what networks take: (..., 3, H, W) float32."""
    return normalise(torch.from_numpy(np.array(frames)).to(device).movedim(-1, -3))


def to_uint8(frames: Tensor) -> npt.NDArray[np.uint8]:
    """What networks draw, (..., 3, H, W) float, to pictures (..., H, W, 3) uint8."""
    array: npt.NDArray[np.uint8] = quantise(frames).movedim(-3, -1).cpu().numpy()
    return array


def as_numbers(given: object, what: str, expected: str) -> Tensor:
    """What somebody hands over, a tensor, an array or nested lists of numbers, as a tensor of real numbers; a
    TypeError, with the argument's name and what is expected, for anything else, such as the name of a file.

    Examples:
        >>> as_numbers([[0.5]], "actions", "floats").shape
        torch.Size([1, 1])
        >>> as_numbers("x.mp4", "frames", "frames as an array")
        Traceback (most recent call last):
        TypeError: frames: got 'x.mp4' (str), expected frames as an array
    """
    if isinstance(given, np.ndarray) and any(stride < 0 for stride in given.strides):
        given = given.copy()  # reversed: torch has no negative strides
    try:
        values = torch.as_tensor(given)
    except (TypeError, ValueError, RuntimeError) as error:
        said = "" if isinstance(given, np.ndarray) else f" {' '.join(repr(given).split())[:60]}"
        kind = f"{given.dtype} array" if isinstance(given, np.ndarray) else type(given).__name__
        raise TypeError(f"{what}: got{said} ({kind}), expected {expected}") from error
    if values.is_complex() or values.is_quantized or values.is_sparse:
        raise TypeError(f"{what}: got {values.dtype}, expected {expected}")
    return values
