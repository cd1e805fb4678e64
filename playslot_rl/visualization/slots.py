"""What each slot holds: reconstruction, objects and segmentation.

Shapes: T frames, N slots, H W image height and width.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt
import torch
from PIL import Image

from playslot_rl.frames import to_float, to_uint8
from playslot_rl.modules.savi import SAVi
from playslot_rl.visualization.grid import image_grid
from playslot_rl.visualization.palette import OKABE_ITO, rgb

Frames = npt.NDArray[np.uint8]


class HasSAVi(Protocol):
    """A world model, as far as the slots are concerned."""

    savi: SAVi


@torch.no_grad()
def slot_cells(model: HasSAVi, frames: Frames) -> Frames:
    """Rows of pictures for a clip.

    Args:
        model: world model; its SAVi parses the clip from the first frame on.
        frames: (T, H, W, 3) uint8.

    Returns:
        (3 + N, T, H, W, 3) uint8: frame, reconstruction, segmentation, then the frame as each slot sees it
        (its colours weighted by its mask, on white).
    """
    device = next(model.savi.parameters()).device
    slots, _ = model.savi(to_float(frames, device)[None], generator=torch.Generator(device).manual_seed(0))
    decoded = model.savi.decode(slots[0])
    objects = decoded.rgb.clamp(0, 1) * decoded.masks + (1 - decoded.masks)
    rows = [frames, to_uint8(decoded.frames), segmentation(to_uint8(decoded.frames), decoded.masks.cpu().numpy())]
    rows += [to_uint8(objects[:, n]) for n in range(objects.shape[1])]
    return np.stack(rows)


def segmentation(frames: Frames, masks: npt.NDArray[np.float32]) -> Frames:
    """Colour each pixel by the slot with the largest mask, over the faded frame.

    Args:
        frames: (T, H, W, 3) uint8.
        masks: (T, N, 1, H, W), sum to one over N.
    """
    colours = np.array([rgb(OKABE_ITO[n % len(OKABE_ITO)]) for n in range(masks.shape[1])], np.float32)
    colour = colours[masks[:, :, 0].argmax(1)]
    grey = frames.astype(np.float32).mean(-1, keepdims=True)
    mixed: Frames = np.clip(0.6 * colour + 0.4 * grey, 0, 255).astype(np.uint8)
    return mixed


def draw_slots(model: HasSAVi, frames: Frames, columns: int = 6) -> Image.Image:
    """Grid for `columns` frames spread evenly over a clip (T, H, W, 3)."""
    cells = slot_cells(model, frames)
    shown = np.unique(np.linspace(0, len(frames) - 1, min(columns, len(frames))).round().astype(int))
    labels = ["frame", "reconstruction", "segmentation", *(f"slot {n + 1}" for n in range(cells.shape[0] - 3))]
    return image_grid(cells[:, shown], labels, [f"t = {t}" for t in shown])
