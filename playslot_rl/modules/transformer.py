"""Pre-norm transformer block with cached keys and values.

    x <- x + O(softmax(Q K^T / sqrt(head_dim)) V),   x <- x + MLP(LN(x))     with Q, K, V = W_{q,k,v} LN(x)

Shapes: x (B, S, dim), S tokens; Q, K, V (B, heads, S, head_dim), inner = heads * head_dim.
q, k, v have no bias; the output projection and the MLP have one (paper, appendix A).

And the [ACT] transformer of InvDyn_S and of the latent policy:

    h = Transformer([ACT], Linear(LN(s_1)), ..., Linear(LN(s_N)))[0]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

KeysValues = tuple[Tensor, Tensor]
"""Cached keys and values of the past tokens, each (B, heads, S_past, head_dim)."""

PRODUCTS_UP_TO = 256
"""Keys up to which bf16 attention is computed by matrix products on a CPU, where torch's fused kernel, made for long
sequences, is slower. In fp32 it is not on one thread, and its sums do not depend on how many rows a process has, which
those of products do: results of several processes would drift from those of one.
"""


def attention(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """softmax(q k^T / sqrt(d) + bias) v (B, heads, S, d) by whichever way is quicker for the device, the precision and
    the keys, of queries (B, heads, S, d), keys and values (B, heads, L, d).

    The mask is bool, True where attention is allowed, or a bias of the logits, broadcastable to (B, heads, S, L).
    """
    short = q.device.type == "cpu" and q.dtype == torch.bfloat16 and k.shape[2] <= PRODUCTS_UP_TO
    by = products if short else F.scaled_dot_product_attention
    return by(q, k, v, mask)


def products(q: Tensor, k: Tensor, v: Tensor, mask: Tensor | None = None) -> Tensor:
    """`attention` by matrix products."""
    logits = q * q.shape[-1] ** -0.5 @ k.transpose(-1, -2)
    if mask is not None:
        logits = logits.masked_fill(~mask, -torch.inf) if mask.dtype == torch.bool else logits + mask
    return torch.softmax(logits, dim=-1) @ v


class TransformerBlock(nn.Module):
    """One pre-norm block; SAVi's transition has no output projection: there heads * head_dim = dim."""

    def __init__(
        self,
        dim: int,
        heads: int,
        head_dim: int,
        mlp_dim: int,
        project_out: bool = True,
        norm: Callable[[int], nn.Module] = nn.LayerNorm,
        activation: Callable[[], nn.Module] = nn.GELU,
    ) -> None:
        super().__init__()
        inner = heads * head_dim
        if not project_out and inner != dim:
            raise ValueError(f"project_out=False: got heads * head_dim = {inner}, expected dim = {dim}")
        self.heads, self.head_dim = heads, head_dim
        self.norm_attention = norm(dim)
        self.to_q = nn.Linear(dim, inner, bias=False)
        self.to_k = nn.Linear(dim, inner, bias=False)
        self.to_v = nn.Linear(dim, inner, bias=False)
        self.to_out: nn.Module = nn.Linear(inner, dim) if project_out else nn.Identity()
        self.norm_mlp = norm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, mlp_dim), activation(), nn.Linear(mlp_dim, dim))

    def forward(
        self,
        x: Tensor,
        mask: Tensor | None = None,
        past: KeysValues | None = None,
        wanted: slice = slice(None),
    ) -> tuple[Tensor, KeysValues]:
        """Transform S new tokens (B, S, dim) that attend to the past and to each other.

        Args:
            mask: bool, True where attention is allowed, or a bias of the logits, broadcastable to
                (B, heads, S, S_past + S).
            past: keys and values of earlier tokens.
            wanted: the new tokens to transform; the others are only attended to. A last layer of which one token is
                read need not compute the rest.

        Returns:
            The wanted tokens (B, S, dim), and the keys and values of past and new tokens together.
        """
        normed = self.norm_attention(x)
        q = self._heads(self.to_q(normed[:, wanted]))
        k, v = self._heads(self.to_k(normed)), self._heads(self.to_v(normed))
        if past is not None:
            k, v = torch.cat((past[0], k), dim=2), torch.cat((past[1], v), dim=2)
        if mask is not None and wanted != slice(None) and mask.shape[-2] > 1:
            mask = mask[..., wanted, :]
        y = attention(q, k, v, mask)
        x = x[:, wanted] + self.to_out(y.transpose(1, 2).flatten(2))
        return x + self.mlp(self.norm_mlp(x)), (k, v)

    def _heads(self, x: Tensor) -> Tensor:
        """(B, S, inner) to (B, heads, S, head_dim)."""
        return x.view(*x.shape[:2], self.heads, self.head_dim).transpose(1, 2)


def chosen_slots(slots: Tensor, numbers: Sequence[int]) -> Tensor:
    """Of slots (..., N, D) those of these numbers, from 1, (..., n, D); all where there are none."""
    # Not by a list as index, which a captured step would have to copy to the GPU.
    return torch.stack([slots[..., number - 1, :] for number in numbers], dim=-2) if numbers else slots


class SlotTokenEncoder(nn.Module):
    """Summarise the slots of one frame in one vector (paper, appendix A.2). No position code, so the result does not
    depend on the order of the slots.
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
        for block in self.blocks[:-1]:
            x, _ = block(x)
        # Of the last layer nothing but [ACT] is read: the rest of it is not computed.
        summary: Tensor = self.blocks[-1](x, wanted=slice(0, 1))[0]
        return summary[:, 0].reshape(*lead, -1)


def sinusoidal_code(length: int, dim: int) -> Tensor:
    """Sinusoidal position code (length, dim) of Vaswani et al., 2017: even columns sine, odd columns cosine."""
    position = torch.arange(length, dtype=torch.float32)[:, None]
    frequency = torch.exp(torch.arange(0, dim, 2, dtype=torch.float32) * (-torch.log(torch.tensor(10000.0)) / dim))
    code = torch.zeros(length, dim)
    code[:, 0::2] = torch.sin(position * frequency)
    code[:, 1::2] = torch.cos(position * frequency)
    return code
