"""A picture that somebody brings: bounded in bytes and in pixels before anything of it is decoded.

Shapes: H W image height and width.
"""

from __future__ import annotations

import io
import warnings
from typing import Final

import numpy as np
import numpy.typing as npt

from playslot_rl.data.frames import resize_frames
from playslot_rl.errors import DataError

MOST_BYTES: Final = 50_000_000
MOST_PIXELS: Final = 64 * 2**20
FORMATS: Final = ("PNG", "JPEG", "WEBP", "GIF", "BMP", "TIFF")
"""Others that Pillow knows need programs of their own (EPS) or decode what a header claims."""


def read_picture(content: bytes, name: str, side: int, whole: bool = False) -> npt.NDArray[np.uint8]:
    """A model's frame, uint8 (side, side, 3), of a picture file, by area averaging: its largest centred square, or all
    of it squeezed into one.

    Raises:
        DataError: it is no picture, or too large.
    """
    if len(content) > MOST_BYTES:
        raise DataError(
            f"{name}: got {len(content) / 1e6:.0f} MB, expected at most {MOST_BYTES // 1_000_000}: make it smaller"
        )
    pixels = _decode(content, name)
    if not whole:
        height, width = pixels.shape[:2]
        cut = min(height, width)
        top, left = (height - cut) // 2, (width - cut) // 2
        pixels = pixels[top : top + cut, left : left + cut]
    frame: npt.NDArray[np.uint8] = resize_frames(pixels[None], side)[0]
    return frame


def _decode(content: bytes, name: str) -> npt.NDArray[np.uint8]:
    from PIL import Image

    size = "too many"
    try:
        # Pillow warns of sizes above the limit here, and of all kinds of damage.
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content), formats=FORMATS) as image:
            size = f"{image.width}x{image.height}"  # from the header, nothing is decoded yet
            if image.width * image.height > MOST_PIXELS:
                raise Image.DecompressionBombError
            if not image.width * image.height:
                raise ValueError
            return np.asarray(image.convert("RGB"))
    except Image.DecompressionBombError as error:
        raise DataError(
            f"{name}: got {size} pixels, expected at most {MOST_PIXELS // 2**20} million: make it smaller"
        ) from error
    except Exception as error:  # a damaged file has Pillow raise whatever its decoders do
        raise DataError(
            f"{name}: got no picture that can be read, expected a PNG or JPEG file: choose another"
        ) from error
