"""A tiny SVG whose BatchNorm has seen frames, so that its outputs depend on its inputs visibly."""

from __future__ import annotations

import pytest
import torch

from playslot_rl.config import OptimConfig
from playslot_rl.methods.svg.method import SVGConfig
from playslot_rl.methods.svg.model import SVG


@pytest.fixture
def config() -> SVGConfig:
    return SVGConfig(
        channels=(4, 8),
        convs=(1, 2),
        features=6,
        latent_dim=3,
        hidden=8,
        seed_frames=3,
        predicted_frames=3,
        batch_size=3,
        optim=OptimConfig(lr=2e-3, schedule="constant", grad_clip=0.0),
    )


@pytest.fixture
def model(config: SVGConfig) -> SVG:
    """In evaluation mode, with weights that are far from their small start."""
    torch.manual_seed(0)
    model, generator = SVG(config, 16), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.ndim > 1:
                parameter.normal_(std=0.3)
        for _ in range(10):
            model(torch.rand(4, 6, 3, 16, 16), 3, generator)
    return model.eval()


@pytest.fixture
def frames() -> torch.Tensor:
    return torch.rand(2, 6, 3, 16, 16, generator=torch.Generator().manual_seed(1))
