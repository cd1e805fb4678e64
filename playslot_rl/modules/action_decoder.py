"""The action decoder: a_t = D_a(z_t), a three-layer MLP (paper, appendix A.4).

Shapes: latent actions (..., Z) -> real actions (..., A) in [-1, 1].

Note: a final tanh keeps the output inside the action space; the paper does not name one. Inputs are standardised by the
mean and scale of the training latents: their scale is free (about 0.07 here), and a decoder on raw ones underfits.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.config import ActionDecoderConfig


class ActionDecoder(nn.Module):
    """Real action from a latent action.

    Args:
        config: sizes.
        latent_dim: Z.
        action_dim: A.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, config: ActionDecoderConfig, latent_dim: int, action_dim: int) -> None:
        super().__init__()
        h = config.hidden_dim
        self.register_buffer("mean", torch.zeros(latent_dim))
        self.register_buffer("scale", torch.ones(latent_dim))
        self.layers = nn.Sequential(
            nn.Linear(latent_dim, h), nn.ReLU(), nn.Linear(h, h), nn.ReLU(), nn.Linear(h, action_dim)
        )

    @torch.no_grad()
    def standardise(self, z: Tensor) -> None:
        """Take mean and scale from latent actions (M, Z)."""
        self.mean.copy_(z.mean(dim=0))
        self.scale.copy_(z.std(dim=0).clamp(min=1e-6))

    def forward(self, z: Tensor) -> Tensor:
        """Latent actions (..., Z) to real actions (..., A)."""
        return torch.tanh(self.layers((z - self.mean) / self.scale))
