"""The slot-aggregation transformer under SOLD's reward, value and actor (Mosbach et al., 2025, section 3.3).

    y_t = Transformer([S_1, o_1], ..., [S_t, o_t])[o_t],   logits(q, k) = q k / sqrt(d) - m_h (step(q) - step(k))

Shapes: slots (B, T, N, D) -> (B, T, dim). M = N + 1 tokens a step, the last of them the output token o (one learned
vector). A token sees all tokens of its own and of earlier steps. Position is in the ALiBi bias alone (Press et al.,
2022), which is equal for all slots of a step: the result does not depend on their order, and sequences may grow longer
than in training.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.modules.transformer import KeysValues, TransformerBlock


def alibi_slopes(heads: int) -> Tensor:
    """Slopes m_h (heads,) of Press et al., 2022: the geometric sequence 2^(-8/heads), 2^(-16/heads), ..., 2^-8."""
    return torch.tensor([2.0 ** (-8.0 * (head + 1) / heads) for head in range(heads)])


def alibi_bias(slopes: Tensor, new: int, past: int, tokens: int) -> Tensor:
    """Bias of the attention logits, causal over steps.

    Args:
        slopes: (heads,).
        new: steps of the queries, the last ones of the sequence.
        past: steps before them.
        tokens: M, tokens a step.

    Returns:
        (heads, new * M, (past + new) * M): -m_h times the steps between, minus infinity for later steps.
    """
    query = torch.arange(past, past + new, device=slopes.device).repeat_interleave(tokens)
    key = torch.arange(past + new, device=slopes.device).repeat_interleave(tokens)
    distance = query[:, None] - key[None, :]
    bias = -slopes[:, None, None] * distance
    return bias.masked_fill(distance < 0, float("-inf"))


class SlotAggregation(nn.Module):
    """Summarise the slots of all steps so far, at every step.

    Args:
        slot_dim: D.
        dim, layers, heads, mlp_dim: the transformer.

    Raises:
        ValueError: `dim` is no multiple of `heads`.

    Example:
        >>> import torch
        >>> model = SlotAggregation(slot_dim=16, dim=32, layers=1, heads=4, mlp_dim=64)
        >>> model(torch.randn(2, 7, 5, 16))[0].shape
        torch.Size([2, 7, 32])
    """

    slopes: Tensor

    def __init__(self, slot_dim: int, dim: int, layers: int, heads: int, mlp_dim: int) -> None:
        super().__init__()
        if dim % heads:
            raise ValueError(f"heads: got {heads}, expected a divisor of dim {dim}")
        self.embed = nn.Linear(slot_dim, dim)
        self.output_token = nn.Parameter(torch.randn(dim) * 0.02)
        self.blocks = nn.ModuleList(TransformerBlock(dim, heads, dim // heads, mlp_dim) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)
        self.register_buffer("slopes", alibi_slopes(heads), persistent=False)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, list[KeysValues]]:
        """Summaries of S new steps.

        Args:
            slots: (B, S, N, D).
            past: what the call on the earlier steps returned.

        Returns:
            (B, S, dim), and the past of the next call.
        """
        b, s, n = slots.shape[:3]
        first = 0 if past is None else past[0][0].shape[2] // (n + 1)
        output = self.output_token.expand(b, s, 1, -1)
        x = torch.cat((self.embed(slots), output), dim=2).flatten(1, 2)
        bias = alibi_bias(self.slopes, s, first, n + 1).to(x.dtype)
        kept: list[KeysValues] = []
        last = len(self.blocks) - 1
        for i, block in enumerate(self.blocks):
            # Only the output tokens of the last layer are read.
            wanted = slice(n, None, n + 1) if i == last else slice(None)
            x, keys_values = block(x, bias, None if past is None else past[i], wanted)
            kept.append(keys_values)
        return self.norm(x), kept
