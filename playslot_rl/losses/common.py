"""What the losses share: TorchRL's convention is that a step minimises the sum of the entries named `loss_*`."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from playslot_rl.frames import psnr
from playslot_rl.runtime.shares import averaged, own_noise


def total_loss(losses: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
    """Sum of the entries named `loss_*` (scalars, weights included). Raises ValueError: there is none."""
    parts = [value for key, value in losses.items() if key.startswith("loss_")]
    if not parts:
        raise ValueError(f"losses: got keys {sorted(losses.keys())}, expected some named loss_*")
    return torch.stack(parts).sum()


def draw_frames(batch: int, frames: int, count: int, generator: torch.Generator | None) -> Tensor | None:
    """Which k = `count` of the T frames of B clips are decoded for an image loss, uniformly without replacement, for
    each clip; None for all of them, where k is 0 or not below T. Without a generator torch's own draws, on the CPU.

    Returns:
        Numbers from 0 (B, k), int64, on the generator's device, or None.
    """
    if not 0 < count < frames:
        return None
    device = "cpu" if generator is None else generator.device
    drawn = own_noise((batch, frames), lambda shape: torch.rand(shape, generator=generator, device=device))
    return drawn.argsort(dim=1)[:, :count]


def of_frames(values: Tensor, chosen: Tensor) -> Tensor:
    """The frames (B, k, ...) of values (B, T, ...) that were drawn: `chosen` (B, k)."""
    chosen = chosen.to(values.device)
    return values[torch.arange(len(values), device=values.device)[:, None], chosen]


def batch_psnr(mse: Tensor) -> Tensor:
    """`playslot_rl.frames.psnr` of a mean squared error, that of the global batch."""
    return psnr(averaged(mse.detach()))
