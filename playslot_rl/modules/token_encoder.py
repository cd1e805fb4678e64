"""The [ACT] transformer of InvDyn_S and of the latent policy.

    h = Transformer([ACT], Linear(LN(s_1)), ..., Linear(LN(s_N)))[0]

Shapes: slots (..., N, D) -> (..., dim). No position code, so the result does not depend on the order of the slots.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.modules.transformer import TransformerBlock


class SlotTokenEncoder(nn.Module):
    """Summarise the slots of one frame in one vector (paper, appendix A.2).

    Args:
        slot_dim: D.
        dim, layers, heads, head_dim, mlp_dim: the transformer.
    """

    def __init__(self, slot_dim: int, dim: int, layers: int, heads: int, head_dim: int, mlp_dim: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(slot_dim)
        self.to_token = nn.Linear(slot_dim, dim)
        self.act_token = nn.Parameter(torch.randn(dim) * 0.02)
        self.blocks = nn.ModuleList(TransformerBlock(dim, heads, head_dim, mlp_dim) for _ in range(layers))

    def forward(self, slots: Tensor) -> Tensor:
        """Slots (..., N, D) to one vector (..., dim)."""
        lead = slots.shape[:-2]
        tokens = self.to_token(self.norm(slots.reshape(-1, *slots.shape[-2:])))
        x = torch.cat((self.act_token.expand(tokens.shape[0], 1, -1), tokens), dim=1)
        for block in self.blocks:
            x, _ = block(x)
        return x[:, 0].reshape(*lead, -1)
