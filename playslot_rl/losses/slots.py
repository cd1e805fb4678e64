"""Stage 1: SAVi's reconstruction loss (paper, Eq. "SAVi loss").

    L = mean (o_t - o^_t)^2,   frames in [0, 1]

Shapes: B batch, T frames, H W image height and width.
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
from playslot_rl.losses.common import psnr
from playslot_rl.modules.savi import Decoded, SAVi


class SlotsLoss(LossModule):
    """Mean squared error between frames and their reconstruction from slots.

    Reads PIXELS uint8 [0, 255] (or float [0, 1]) of shape (B, T, 3, H, W), clips that each start an episode.
    Writes `loss_reconstruction` and, to be logged, `psnr` (dB).

    Args:
        savi: the model that is trained.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
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
        """Keys that `set_keys` can rename.

        Attributes:
            pixels: frames of the clips.
        """

        pixels: NestedKey = keys.PIXELS

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ("loss_reconstruction", "psnr")

    def __init__(self, savi: SAVi) -> None:
        super().__init__()
        self.savi = savi

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that are read."""
        return [self.tensor_keys.pixels]

    def forward(self, tensordict: TensorDictBase, generator: torch.Generator | None = None) -> TensorDictBase:
        """Parse, render, compare.

        Args:
            tensordict: PIXELS (B, T, 3, H, W).
            generator: of sampled initial slots.
        """
        frames, decoded = self.reconstruct(tensordict, generator)
        mse = (decoded.frames - frames).square().mean()
        return TensorDict({"loss_reconstruction": mse, "psnr": psnr(mse)}, [])

    def reconstruct(
        self, tensordict: TensorDictBase, generator: torch.Generator | None = None
    ) -> tuple[Tensor, Decoded]:
        """Frames (B, T, 3, H, W) in [0, 1] and what SAVi makes of them; arguments as of `forward`."""
        frames = normalise(tensordict.get(self.tensor_keys.pixels))
        slots, _ = self.savi(frames, generator=generator)
        return frames, self.savi.decode(slots)
