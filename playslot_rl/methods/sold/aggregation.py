"""SOLD's slot-aggregation transformer (Mosbach et al., 2025, section 3.3): the slots of all steps so far, summarised at
every step.

    y_t = Transformer([S_1, o_1], ..., [S_t, o_t])[o_t],   logits(q, k) = q k / sqrt(d) - m_h (step(q) - step(k))

Shapes: B sequences or episodes, S new steps after P earlier ones, slots (B, S, N, D) -> (B, S, dim). M = N + 1 tokens a
step, the last of them the output token o (one learned vector). A token sees all slots of its own and of earlier steps,
and the output token of its own step only. Position is in the ALiBi bias alone (Press et al., 2022), which is equal for
all slots of a step: the result does not depend on their order, and sequences may grow longer than in training.

Of earlier steps nothing but the slots' keys and values is needed: they are kept, and a new step costs one step.

Note: as in the source, the slopes are the square roots of ALiBi's: the longest memory fades by e in 16 steps instead of
256, the shortest in 1.4 instead of 2. Unlike there, queries, keys and values have no bias.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from playslot_rl.modules.transformer import KeysValues, TransformerBlock


def alibi_slopes(heads: int) -> Tensor:
    """Slopes m_h (heads,): the geometric sequence 2^(-4/heads), 2^(-8/heads), ..., 2^-4."""
    return torch.tensor([2.0 ** (-4.0 * (head + 1) / heads) for head in range(heads)])


def alibi_bias(slopes: Tensor, new: int, past: int, slots: int) -> Tensor:
    """Bias of the attention logits, causal over steps, of the tokens of `new` steps after `past` ones.

    Returns:
        (heads, new * M, past * N + new * M): -m_h times the steps between, minus infinity for later steps and for
        earlier steps' output tokens, which are not among the past's keys at all.
    """
    query = torch.arange(past, past + new, device=slopes.device).repeat_interleave(slots + 1)
    key = torch.cat((torch.arange(past, device=slopes.device).repeat_interleave(slots), query))
    output = torch.arange(len(key), device=slopes.device) - past * slots
    output = (output >= 0) & (output % (slots + 1) == slots)
    distance = query[:, None] - key
    hidden = (distance < 0) | (output & (distance > 0))
    return (-slopes[:, None, None] * distance).masked_fill(hidden, float("-inf"))


class SlotAggregation(nn.Module):
    """Summarise the slots of all steps so far, at every step; a ValueError where `dim` is no multiple of `heads`.

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
        self.output_token = nn.Parameter(torch.empty(dim).uniform_(-1, 1) * (3 / dim) ** 0.5)
        self.blocks = nn.ModuleList(
            TransformerBlock(dim, heads, dim // heads, mlp_dim, norm=nn.RMSNorm, activation=nn.SiLU)
            for _ in range(layers)
        )
        self.register_buffer("slopes", alibi_slopes(heads), persistent=False)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, list[KeysValues]]:
        """Summaries (B, S, dim) of S new steps' slots (B, S, N, D), and the past of the next call: of each layer the
        slots' keys and values (B, heads, (P + S) N, dim / heads).
        """
        s, n = slots.shape[1:3]
        before = 0 if past is None else past[0][0].shape[2]
        return self._run(slots, alibi_bias(self.slopes, s, before // n, n), past)

    def _run(self, slots: Tensor, bias: Tensor, past: list[KeysValues] | None) -> tuple[Tensor, list[KeysValues]]:
        b, s, n = slots.shape[:3]
        x = torch.cat((self.embed(slots), self.output_token.expand(b, s, 1, -1)), dim=2).flatten(1, 2)
        bias, kept = bias.to(x.dtype), list[KeysValues]()
        for i, block in enumerate(self.blocks):
            # Of the last layer only the output tokens are read.
            wanted = slice(n, None, n + 1) if i == len(self.blocks) - 1 else slice(None)
            x, (k, v) = block(x, bias, None if past is None else past[i], wanted)
            kept.append((_slots_only(k, s, n), _slots_only(v, s, n)))
        return x, kept

    def blank(self, episodes: int, frames: int, slots: int) -> Tensor:
        """What `step` keeps of so many new episodes, of their last `frames` frames each, (B, layers, 2, frames, N,
        dim).
        """
        return self.output_token.new_zeros(
            episodes, len(self.blocks), 2, frames, slots, len(self.output_token), requires_grad=False
        )

    def step(self, slots: Tensor, kept: Tensor, age: Tensor) -> tuple[Tensor, Tensor]:
        """One frame more of each of B episodes: what `forward` says at the last of an episode's frames.

        Args:
            slots: (B, N, D), of the new frame.
            kept: as `blank` makes it and this returns it; the frame of step t lies at t modulo `frames`, so that of
                longer episodes the last `frames` are attended to.
            age: (B,) int64, frames seen before this one.

        Returns:
            Summaries (B, dim), and `kept` with the new frame.
        """
        b, frames, n = len(slots), kept.shape[3], slots.shape[1]
        filled = min(int(age.max()), frames)
        distance = (age[:, None] - torch.arange(filled, device=age.device)) % frames
        seen = (distance > 0) & (distance <= age[:, None])
        bias = (-self.slopes[:, None] * distance[:, None]).masked_fill(~seen[:, None], float("-inf"))
        own = bias.new_zeros(*bias.shape[:2], n + 1)
        bias = torch.cat((bias.repeat_interleave(n, dim=-1), own), dim=-1).unsqueeze(-2)
        heads, layers = len(self.slopes), range(kept.shape[1])
        # (B, layers, 2, frames, N, dim) to keys and values (B, heads, frames N, dim / heads)
        parts = kept[:, :, :, :filled].flatten(3, 4).unflatten(-1, (heads, -1)).transpose(3, 4)
        past = [(parts[:, i, 0], parts[:, i, 1]) for i in layers]
        summary, now = self._run(slots.unsqueeze(1), bias.expand(-1, -1, n + 1, -1), past)
        new = torch.stack([torch.stack([part[:, :, -n:] for part in now[i]], dim=1) for i in layers], dim=1)
        kept = kept.clone()
        kept[torch.arange(b, device=age.device), :, :, age % frames] = new.transpose(3, 4).flatten(-2)
        return summary[:, 0], kept


def _slots_only(tokens: Tensor, steps: int, slots: int) -> Tensor:
    """Keys or values (B, heads, P N + S M, d) without those of output tokens, (B, heads, (P + S) N, d)."""
    past, new = tokens.tensor_split([tokens.shape[2] - steps * (slots + 1)], dim=2)
    return torch.cat((past, new.unflatten(2, (steps, slots + 1))[:, :, :, :slots].flatten(2, 3)), dim=2)
