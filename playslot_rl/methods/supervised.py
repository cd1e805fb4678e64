"""What models of latent actions share that a few real actions supervise: the labelled transitions beside the videos.

Shapes: M labelled transitions, B batch, b own share of it, T frames of an example,
A action width, H W image height and width.
"""

from __future__ import annotations

import torch
from torch import Tensor

from playslot_rl.config import ExperimentConfig
from playslot_rl.data.demonstrations import moving_frames, real_actions
from playslot_rl.data.device_rows import DeviceRows
from playslot_rl.data.neighbours import Ends
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import IntArray
from playslot_rl.runtime.devices import to_device
from playslot_rl.runtime.shares import own_noise, own_rows
from playslot_rl.seeds.draws import StepGenerators
from playslot_rl.training.stage_regression import shifted


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
    """Frames (b, T, 3, H, W), those of a row moved alike by a random offset of at most `shift` pixels; edges repeat."""
    if shift == 0:
        return pixels
    generator, (rows, times) = generators.torch(stream, "cpu"), pixels.shape[:2]
    offsets = own_noise((rows, 2), lambda shape: torch.randint(2 * shift + 1, shape, generator=generator)) - shift
    moved = shifted(pixels.flatten(0, 1), to_device(offsets.repeat_interleave(times, dim=0), pixels.device))
    return moved.view_as(pixels)
