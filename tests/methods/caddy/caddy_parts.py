"""A tiny CADDY whose predictions depend visibly on everything that they may depend on."""

from __future__ import annotations

import torch

from playslot_rl.config import OptimConfig
from playslot_rl.methods.caddy.method import CADDYConfig
from playslot_rl.methods.caddy.model import CADDY

SIZE = 16


def tiny_config(**changes: object) -> CADDYConfig:
    settings: dict[str, object] = {
        "encoder": (4, 4, 6, 8),
        "dynamics": 8,
        "generator": (8, 6, 4),
        "actions": 3,
        "latent_dim": 2,
        "seed_frames": 2,
        "predicted_frames": 3,
        "first_frames": 3,
        "optim": OptimConfig(lr=3e-3, warmup_steps=0, schedule="constant", grad_clip=0.0),
    }
    return CADDYConfig(**(settings | changes))  # type: ignore[arg-type]


def tiny(size: int = SIZE, **changes: object) -> CADDY:
    """A model of random weights, statistics and centroids: untrained ones would make everything nearly the same."""
    torch.manual_seed(0)
    model = CADDY(tiny_config(**changes), size)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.mul_(2)
        model.action.to_logits.weight.mul_(20)
        model.action.centroids.normal_()
    return model


def clips(batch: int = 3, frames: int = 5, size: int = SIZE, seed: int = 0) -> torch.Tensor:
    return torch.rand(batch, frames, 3, size, size, generator=torch.Generator().manual_seed(seed))
