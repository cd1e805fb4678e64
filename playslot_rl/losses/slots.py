"""Stage 1: SAVi's reconstruction loss (paper, Eq. "SAVi loss").

    L = mean (o_t - o^_t)^2,   frames in [0, 1]

With a motion weight lambda and a foreground weight mu, what is of interest counts more, in each clip b by itself:

    L = mean_b  sum_{t,p} w_{b,t,p} (o - o^)^2 / sum_{t,p} w_{b,t,p},   w = 1 + lambda m + mu f

where m_{b,t,p} is 1 where the pixel changes from the frame before or to the one after, and f_{b,t,p} where it is not
that of the clip's background, the median of frames of its scene, else 0: a goal that lies still moves in no clip.

Note: the paper has lambda = mu = 0. Small things over a ground that stays are a few hundredths of the plain error, and
SAVi learns the ground alone for a long time.

Shapes: B batch, T frames, K scenes, H W image height and width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule

from playslot_rl import keys
from playslot_rl.frames import normalise
from playslot_rl.losses.common import batch_psnr
from playslot_rl.modules.savi import Decoded, SAVi
from playslot_rl.modules.savi.health import moves


class SlotsLoss(LossModule):
    """Mean squared error between frames and their reconstruction from slots.

    Reads PIXELS uint8 [0, 255] (or float [0, 1]) of shape (B, T, 3, H, W), clips that each start an episode.
    Writes `loss_reconstruction` and, to be logged, `psnr` (dB).

    Args:
        savi: the model that is trained.
        motion_weight: lambda.
        foreground_weight: mu.
        backgrounds: frames (K, 3, H, W) in [0, 1], each from `background`; needed where mu is not 0.

    Raises:
        ValueError: mu, but no backgrounds.

    Examples:
        >>> from playslot_rl.testing import tiny_agent
        >>> loss = SlotsLoss(tiny_agent().world_model.savi)
        >>> clips = TensorDict({"pixels": torch.randint(256, (2, 3, 3, 64, 64), dtype=torch.uint8)}, [2])
        >>> out = loss(clips)
        >>> out["loss_reconstruction"].backward()
        >>> sorted(out.keys())
        ['loss_reconstruction', 'psnr']
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that `set_keys` can rename."""

        pixels: NestedKey = keys.PIXELS

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ("loss_reconstruction", "psnr")

    def __init__(
        self,
        savi: SAVi,
        motion_weight: float = 0.0,
        foreground_weight: float = 0.0,
        backgrounds: Tensor | None = None,
    ) -> None:
        super().__init__()
        if foreground_weight and backgrounds is None:
            raise ValueError(
                f"SlotsLoss: got foreground_weight={foreground_weight:g} without backgrounds, expected one or more: "
                "give what `losses.slots.background` makes of some frames of each scene"
            )
        self.savi, self.motion_weight, self.foreground_weight = savi, motion_weight, foreground_weight
        self.backgrounds = backgrounds

    @property
    def in_keys(self) -> list[NestedKey]:
        return [self.tensor_keys.pixels]

    def forward(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDictBase:
        """Parse, render, compare; the generator is of sampled initial slots."""
        frames, decoded = self.reconstruct(tensordict, generator)
        error = (decoded.frames - frames).square()
        mse = error.mean()
        loss = mse
        if self.motion_weight or self.foreground_weight:
            weight = 1.0 + self.motion_weight * moving(frames)
            if self.backgrounds is not None:
                weight = weight + self.foreground_weight * foreground(frames, self.backgrounds)
            loss = ((weight * error.mean(2)).sum((1, 2, 3)) / weight.sum((1, 2, 3))).mean()
        return TensorDict({"loss_reconstruction": loss, "psnr": batch_psnr(mse)}, [])

    def reconstruct(
        self, tensordict: TensorDictBase, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Decoded]:
        """Frames (B, T, 3, H, W) in [0, 1] and what SAVi makes of them; arguments as of `forward`."""
        frames = normalise(tensordict.get(self.tensor_keys.pixels))
        slots, _ = self.savi(frames, generator=generator)
        return frames, self.savi.decode(slots)


def moving(frames: Tensor) -> Tensor:
    """1 where a pixel changes from the frame before or to the one after, else 0: (B, T, H, W) of (B, T, 3, H, W)."""
    changed = moves(frames[:, 1:] - frames[:, :-1]).squeeze(2).to(frames.dtype)
    either = torch.zeros_like(frames[:, :, 0])
    either[:, 1:] = changed
    either[:, :-1] = torch.maximum(either[:, :-1], changed)
    return either


def background(frames: Tensor) -> Tensor:
    """What each pixel mostly is, the median of frames (..., 3, H, W): float32 (3, H, W) in [0, 1]."""
    return normalise(frames.flatten(0, -4)).median(0).values


def foreground(frames: Tensor, backgrounds: Tensor) -> Tensor:
    """1 where a pixel is not the background's, else 0: (B, T, H, W) of (B, T, 3, H, W). Of the backgrounds (K, 3, H, W)
    a clip's is the one from which its first frame differs in the fewest pixels.
    """
    scene = moves(frames[:, :1] - backgrounds).sum((2, 3, 4)).argmin(1)
    return moves(frames - backgrounds[scene][:, None]).squeeze(2).to(frames.dtype)
