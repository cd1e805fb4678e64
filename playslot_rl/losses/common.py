"""What the losses share: TorchRL's convention is that a step minimises the sum of the entries named `loss_*`."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor

from playslot_rl.frames import psnr
from playslot_rl.shares import averaged


def total_loss(losses: TensorDictBase | Mapping[str, Tensor]) -> Tensor:
    """Sum of the entries named `loss_*` (scalars, weights included).

    Raises:
        ValueError: there is none.
    """
    parts = [value for key, value in losses.items() if key.startswith("loss_")]
    if not parts:
        raise ValueError(f"losses: got keys {sorted(losses.keys())}, expected some named loss_*")
    return torch.stack(parts).sum()


def batch_psnr(mse: Tensor) -> Tensor:
    """`playslot_rl.frames.psnr` of a mean squared error, that of the global batch."""
    return psnr(averaged(mse.detach()))
