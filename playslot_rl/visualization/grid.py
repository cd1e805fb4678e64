"""Labelled grids of small frames, pixel for pixel.

Shapes: R rows, C columns, H W frame height and width. Frames are uint8 [0, 255].
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from playslot_rl.visualization.palette import LABEL

Frames = npt.NDArray[np.uint8]
GAP = 4


def image_grid(cells: Frames, rows: Sequence[str] = (), columns: Sequence[str] = (), scale: int = 2) -> Image.Image:
    """One picture of R times C frames with row labels on the left and column labels above.

    Args:
        cells: (R, C, H, W, 3).
        rows: R labels, or none.
        columns: C labels, or none.
        scale: enlargement without interpolation; frames are small, blurring would hide their pixels.

    Returns:
        RGBA picture with a transparent ground, so that it suits light and dark pages.

    Raises:
        ValueError: wrong shape or number of labels.
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


def png(picture: Image.Image) -> bytes:
    """Bytes of a picture."""
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return buffer.getvalue()
