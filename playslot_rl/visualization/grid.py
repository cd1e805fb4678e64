"""Labelled grids of small frames, pixel for pixel, and animated PNGs: lossless, shown by browsers and code hosts.

Shapes: R rows, C columns, T frames, H W frame height and width. Frames are uint8 [0, 255].
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from playslot_rl.visualization.charts import LABEL

Frames = npt.NDArray[np.uint8]
GAP = 4


def image_grid(cells: Frames, rows: Sequence[str] = (), columns: Sequence[str] = (), scale: int = 2) -> Image.Image:
    """One RGBA picture of frames (R, C, H, W, 3) with R row labels on the left and C column labels above, or none; its
    transparent ground suits light and dark pages. They are enlarged without interpolation: frames are small, blurring
    would hide their pixels. A ValueError for another shape or number of labels.
    """
    if cells.ndim != 5 or cells.shape[-1] != 3:
        raise ValueError(f"image_grid: got cells {cells.shape}, expected (R, C, H, W, 3)")
    r, c, h, w = cells.shape[:4]
    if (rows and len(rows) != r) or (columns and len(columns) != c):
        raise ValueError(f"image_grid: got {len(rows)} row and {len(columns)} column labels, expected {r} and {c}")
    font = ImageFont.load_default(size=13)
    left = max((int(font.getlength(label)) for label in rows), default=-10) + 10
    top = 20 if columns else 0
    step_x, step_y = w * scale + GAP, h * scale + GAP
    picture = Image.new("RGBA", (left + c * step_x - GAP, top + r * step_y - GAP), (0, 0, 0, 0))
    draw = ImageDraw.Draw(picture)
    for i in range(r):
        if rows:
            draw.text((left - 8, top + i * step_y + h * scale // 2), rows[i], fill=LABEL, font=font, anchor="rm")
        for j in range(c):
            cell = Image.fromarray(cells[i, j]).resize((w * scale, h * scale), Image.Resampling.NEAREST)
            picture.paste(cell, (left + j * step_x, top + i * step_y))
    for j, label in enumerate(columns):
        draw.text((left + j * step_x + w * scale // 2, 9), label, fill=LABEL, font=font, anchor="mm")
    return picture


def film_strip(clips: Frames, rows: Sequence[str], columns: int = 8, first: int = 0) -> Image.Image:
    """Frames spread evenly over the time of R clips (R, T, H, W, 3), whose first frame is that of step `first`."""
    shown = np.unique(np.linspace(0, clips.shape[1] - 1, min(columns, clips.shape[1])).round().astype(int))
    return image_grid(clips[:, shown], rows, [f"t = {first + t}" for t in shown])


def animation(pictures: list[Image.Image], fps: float = 6.0) -> bytes:
    """Endless APNG of pictures of one size, whose last one stays a little longer; a ValueError for none, or no rate."""
    if not pictures or fps <= 0:
        raise ValueError(
            f"animation: got {len(pictures)} frames at {fps} fps, expected at least one and a positive rate"
        )
    times = [1000.0 / fps] * (len(pictures) - 1) + [1200.0]
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
    """Pictures of an animation of clips (E, C, T, H, W, 3): one row an episode, one column a way of running it."""
    return [image_grid(clips[:, :, t], rows, columns, scale) for t in range(clips.shape[2])]
