"""Animated PNGs: lossless, shown by every browser and by code hosts.

Shapes: E episodes, C columns, T frames, H W frame height and width. Frames are uint8 [0, 255].
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image

from playslot_rl.visualization.grid import image_grid

Frames = npt.NDArray[np.uint8]


def animation(pictures: list[Image.Image], fps: float = 6.0, pause: float = 1.2) -> bytes:
    """Endless APNG.

    Args:
        pictures: its frames, of one size.
        fps: frames per second, more than 0.
        pause: seconds that the last frame stays.

    Raises:
        ValueError: no pictures, or a rate that is not positive.
    """
    if not pictures or fps <= 0:
        raise ValueError(
            f"animation: got {len(pictures)} frames at {fps} fps, expected at least one and a positive rate"
        )
    times = [1000.0 / fps] * (len(pictures) - 1) + [1000.0 * pause]
    buffer = io.BytesIO()
    pictures[0].save(
        buffer,
        format="PNG",
        save_all=True,
        append_images=pictures[1:],
        duration=times,
        loop=0,
        disposal=1,  # clear before each frame: the ground is transparent and labels would otherwise smear
        blend=0,
    )
    return buffer.getvalue()


def side_by_side(clips: Frames, columns: Sequence[str], rows: Sequence[str], scale: int = 2) -> list[Image.Image]:
    """Pictures of an animation: one row an episode, one column a way of running it.

    Args:
        clips: (E, C, T, H, W, 3).
        columns: C labels.
        rows: E labels.
        scale: enlargement.

    Raises:
        ValueError: wrong shape or number of labels.
    """
    if clips.ndim != 6:
        raise ValueError(f"side_by_side: got clips {clips.shape}, expected (E, C, T, H, W, 3)")
    return [image_grid(clips[:, :, t], rows, columns, scale) for t in range(clips.shape[2])]
