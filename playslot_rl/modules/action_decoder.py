"""The action decoder: a_t = D_a(z_t), a three-layer MLP (system.md section 4; paper, appendix A.4).

Shapes: latent actions (..., Z) -> real actions (..., A) in [-1, 1].

Note: a final tanh keeps the output inside the action space; the paper does not name one.
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

    def __init__(self, config: ActionDecoderConfig, latent_dim: int, action_dim: int) -> None:
        super().__init__()
        h = config.hidden_dim
        self.layers = nn.Sequential(
            nn.Linear(latent_dim, h), nn.ReLU(), nn.Linear(h, h), nn.ReLU(), nn.Linear(h, action_dim)
        )

    def forward(self, z: Tensor) -> Tensor:
        """Latent actions (..., Z) to real actions (..., A)."""
        return torch.tanh(self.layers(z))
