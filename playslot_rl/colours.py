"""Colours that stand for slots and series: the Okabe-Ito palette, which colour-blind readers can tell apart.

Shapes: T frames, N slots, H W image height and width.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

OKABE_ITO: Final = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#7F7F7F")


def segmentation(frames: npt.NDArray[np.uint8], masks: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
    """Colour each pixel of frames (T, H, W, 3) uint8 by the slot with the largest mask (T, N, 1, H, W), over the faded
    frame.
    """
    named = [tuple(bytes.fromhex(OKABE_ITO[n % len(OKABE_ITO)][1:])) for n in range(masks.shape[1])]
    colour = np.array(named, np.float32)[masks[:, :, 0].argmax(1)]
    grey = frames.astype(np.float32).mean(-1, keepdims=True)
    mixed: npt.NDArray[np.uint8] = np.clip(0.6 * colour + 0.4 * grey, 0, 255).astype(np.uint8)
    return mixed
