"""SAVi's corrector, Slot Attention (Eq. "slot attention" and "slot update"; paper, appendix A.1).

    A = softmax_N(q(LN(S)) k(LN(h))^T / sqrt(D)) + 1e-8,   A_{n,l} <- A_{n,l} / sum_i A_{n,i}
    S <- GRU(A v(LN(h)), S),   S <- S + MLP(LN(S))

Shapes: slots S (B, N, D), tokens h (B, L, token_dim), A (B, N, L).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

EPSILON = 1e-8


class SlotAttention(nn.Module):
    """The corrector.

    Args:
        slot_dim: D, also the width of q, k, v.
        token_dim: width of the feature tokens.
        mlp_dim: hidden width of the residual MLP.
    """

    def __init__(self, slot_dim: int, token_dim: int, mlp_dim: int) -> None:
        super().__init__()
        self.scale = slot_dim**-0.5
        self.norm_inputs = nn.LayerNorm(token_dim)
        self.norm_slots = nn.LayerNorm(slot_dim)
        self.norm_mlp = nn.LayerNorm(slot_dim)
        self.to_q = nn.Linear(slot_dim, slot_dim, bias=False)
        self.to_k = nn.Linear(token_dim, slot_dim, bias=False)
        self.to_v = nn.Linear(token_dim, slot_dim, bias=False)
        self.gru = nn.GRUCell(slot_dim, slot_dim)
        self.mlp = nn.Sequential(nn.Linear(slot_dim, mlp_dim), nn.ReLU(), nn.Linear(mlp_dim, slot_dim))

    def keys_values(self, tokens: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values of feature tokens (..., L, token_dim): each (..., L, D)."""
        normed = self.norm_inputs(tokens)
        return self.to_k(normed), self.to_v(normed)

    def forward(self, k: Tensor, v: Tensor, slots: Tensor, iterations: int) -> Tensor:
        """Refine slots (B, N, D) against keys and values (B, L, D), of whatever precision."""
        b, n, d = slots.shape
        for _ in range(iterations):
            q = self.to_q(self.norm_slots(slots)).to(k.dtype)
            attention = torch.softmax((q @ k.transpose(1, 2)).to(slots.dtype) * self.scale, dim=1) + EPSILON
            attention = attention / attention.sum(dim=2, keepdim=True)
            updates = (attention.to(v.dtype) @ v).to(slots.dtype)
            slots = self.gru(updates.reshape(b * n, d), slots.reshape(b * n, d)).view(b, n, d)
            slots = slots + self.mlp(self.norm_mlp(slots))
        return slots
