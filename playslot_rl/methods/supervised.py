"""What models of latent actions share that a few real actions supervise: the labelled transitions beside the videos.

Shapes: F rows (frames) of a data set, M labelled transitions, B batch, b own share of it, T frames of an example,
A action width, H W image height and width.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import moving_frames, real_actions
from playslot_rl.data.device_rows import DeviceRows
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.windows import IntArray
from playslot_rl.runtime.devices import to_device
from playslot_rl.runtime.shares import own_noise, own_rows
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training.stage_regression import shifted


class Ends(NamedTuple):
    """Rows of the first and of the last frame of the episode that each row belongs to, int64 (F,); -1 where none."""

    first: IntArray
    last: IntArray

    @classmethod
    def of(cls, source: EpisodeFrames) -> Ends:
        first, last = np.full((2, len(source.frames)), -1, np.int64)
        for start, length in zip(source.starts, source.lengths, strict=True):
            first[start : start + length], last[start : start + length] = start, start + length - 1
        return cls(first, last)

    def before(self, rows: IntArray) -> IntArray:
        """The row before each (...), or itself at an episode's start."""
        before: IntArray = np.maximum(rows - 1, self.first[rows])
        return before

    def ahead(self, rows: IntArray, most: int, numbers: np.random.Generator) -> IntArray:
        """A row 1 to `most` steps after each of `rows` (...), which are no last ones, uniformly within its episode."""
        reach = np.minimum(most, self.last[rows] - rows)
        ahead: IntArray = rows + 1 + (numbers.random(rows.shape) * reach).astype(np.int64)
        return ahead


class LabelledMoves:
    """The transitions of labelled demonstrations in which something moves: `rows` int64 (M,), real `actions` (M, A) in
    [-1, 1]; a DataError where there are no actions, or nothing moves.
    """

    def __init__(self, source: EpisodeFrames, config: ExperimentConfig, device: torch.device) -> None:
        self.rows = moving_frames(source, config.behaviour.trim_pixels, config.behaviour.trim_margin).rows
        self.actions = real_actions(source, self.rows, config.env.action_dim).to(device)
        self.ends = Ends.of(source)
        self.pixels = DeviceRows(source.pixels, len(source.frames), device, config.data.device == "auto")

    def draw(self, count: int, generators: StepGenerators) -> tuple[IntArray, Tensor]:
        """Rows (B,), drawn uniformly with replacement, and the actions (b, A) of the own ones."""
        drawn = generators.numpy("labelled").integers(len(self.rows), size=count)
        return self.rows[drawn], self.actions[to_device(torch.from_numpy(own_rows(drawn)), self.actions.device)]


def jittered(pixels: Tensor, shift: int, generators: StepGenerators, stream: str) -> Tensor:
    """Frames (b, T, 3, H, W), each moved by its own random offset of at most `shift` pixels; edges repeat."""
    if shift == 0:
        return pixels
    generator = generators.torch(stream, "cpu")
    offsets = own_noise((*pixels.shape[:2], 2), lambda shape: torch.randint(2 * shift + 1, shape, generator=generator))
    moved = shifted(pixels.flatten(0, 1), to_device(offsets.flatten(0, 1) - shift, pixels.device))
    return moved.view_as(pixels)
