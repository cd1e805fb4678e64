"""Frames of a data set as inputs of a regression (`playslot_rl.training.stage_regression`), shifted in training.

Shapes: M rows, b rows of a batch, H W image height and width.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.data.demonstrations import real_actions, transitions
from playslot_rl.data.shifted import shift_frames
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
        if self.shift == 0:
            return self.plain(rows)
        offsets = torch.randint(2 * self.shift + 1, (len(rows), 2), generator=generators.torch("shift", "cpu"))
        frames = self.source.frames[self.rows[rows.cpu().numpy()]]
        moved = shift_frames(frames, offsets.numpy() - self.shift)
        return torch.from_numpy(moved).movedim(-1, 1).to(self.device)

    def plain(self, rows: Tensor) -> Tensor:
        """Frames of rows, as they are."""
        return self.source.pixels(self.rows[rows.cpu().numpy()]).to(self.device)


def demonstrated_frames(
    source: EpisodeFrames, action_dim: int, device: torch.device | str, shift: int = 0
) -> tuple[FrameInputs, Tensor]:
    """Frames of all transitions of demonstrations, with their real actions (M, A) in [-1, 1].

    Raises:
        DataError: no transition, no actions, or actions of another width.
    """
    rows = transitions(source).rows
    return FrameInputs(source, rows, device, shift), real_actions(source, rows, action_dim).to(device)
