"""Frames of a data set as inputs of a regression (`playslot_rl.training.stage_regression`), shifted in training.

Shapes: M rows, b rows of a batch, H W image height and width.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.data.source import EpisodeFrames
from playslot_rl.seeding import StepGenerators


class FrameInputs:
    """Frames by row: uint8 (b, 3, H, W), [0, 255].

    Args:
        source: the data set.
        rows: its frames' row numbers, int64 (M,).
        device: where the frames go.
        shift: largest shift in training, pixels.
    """

    def __init__(
        self, source: EpisodeFrames, rows: npt.NDArray[np.int64], device: torch.device | str, shift: int = 0
    ) -> None:
        self.source, self.rows, self.device, self.shift = source, rows, device, shift

    def __len__(self) -> int:
        return len(self.rows)

    def draw(self, rows: Tensor, generators: StepGenerators) -> Tensor:
        """Frames of rows, each shifted by its own random offset."""
        frames = self.plain(rows)
        if self.shift == 0:
            return frames
        offsets = torch.randint(2 * self.shift + 1, (len(rows), 2), generator=generators.torch("shift", "cpu"))
        return shifted(frames, offsets.to(frames.device) - self.shift)

    def plain(self, rows: Tensor) -> Tensor:
        """Frames of rows, as they are."""
        return self.source.pixels(self.rows[rows.cpu().numpy()]).to(self.device)


def shifted(frames: Tensor, offsets: Tensor) -> Tensor:
    """Frames (b, 3, H, W) moved by offsets int64 (b, 2) in pixels (down, right); edges are repeated.

    Example:
        >>> frame = torch.tensor([[1, 2], [3, 4]], dtype=torch.uint8).expand(1, 3, 2, 2)
        >>> shifted(frame, torch.tensor([[0, 1]]))[0, 0].tolist()
        [[1, 1], [3, 3]]
    """
    b, _, h, w = frames.shape
    down = (torch.arange(h, device=frames.device) - offsets[:, :1]).clamp(0, h - 1)
    right = (torch.arange(w, device=frames.device) - offsets[:, 1:]).clamp(0, w - 1)
    batch = torch.arange(b, device=frames.device)[:, None, None]
    return frames[batch, :, down[:, :, None], right[:, None, :]].movedim(-1, 1)
