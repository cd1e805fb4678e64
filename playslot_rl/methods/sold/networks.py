"""SOLD's trained networks (Mosbach et al., 2025, section 3.3): the dynamics, and reward, value and actor, each a
slot-aggregation transformer and a linear layer. SAVi, which is frozen, is not among them.

    y_t = Transformer([S_1, o_1], ..., [S_t, o_t])[o_t],   logits(q, k) = q k / sqrt(d) - m_h (step(q) - step(k))

Shapes: slots (B, S, N, D) -> (B, S, dim), A action width. M = N + 1 tokens a step, the last of them the output token o
(one learned vector). A token sees all tokens of its own and of earlier steps. Position is in the ALiBi bias alone
(Press et al., 2022), which is equal for all slots of a step: the result does not depend on their order, and sequences
may grow longer than in training. All take the past that they returned for the earlier steps, so a step of imagination
costs one step.

Scalars are categories on a symlog grid (Hafner et al., 2023):

    target: two-hot(symlog(x)),   p = softmax(l),   b_k evenly spaced in [-limit, limit]
    decoded, linear: x^ = sum_k p_k symexp(b_k)      decoded, symlog: x^ = symexp(sum_k p_k b_k)

Note: the linear mean is the source's and unbiased. On its grid of +-20, values of up to 4.9e8, TorchRL's
`SymExpTwoHot` is the same. But SOLD's actor is trained through decoded rewards and values, where the gradient of a bin
of 4.9e8 drowns all others. So either the grid ends where returns do, or the mean is taken in symlog, which stays of
the size of the value and is too low where the head is uncertain (between 10 and 200 it says 46, not 105).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torchrl.modules import TruncatedNormal, symexp, symlog
from torchrl.objectives import two_hot_cross_entropy, two_hot_decode

from playslot_rl.config import PredictorConfig
from playslot_rl.methods.sold.method import SOLDConfig
from playslot_rl.modules.predictors.ocvp_seq import OCVPSeq
from playslot_rl.modules.transformer import KeysValues, TransformerBlock


def alibi_slopes(heads: int) -> Tensor:
    """Slopes m_h (heads,) of Press et al., 2022: the geometric sequence 2^(-8/heads), 2^(-16/heads), ..., 2^-8."""
    return torch.tensor([2.0 ** (-8.0 * (head + 1) / heads) for head in range(heads)])


def alibi_bias(slopes: Tensor, new: int, past: int, tokens: int) -> Tensor:
    """Bias of the attention logits, causal over steps, of queries of `new` steps after `past` ones.

    Returns:
        (heads, new * M, (past + new) * M): -m_h times the steps between, minus infinity for later steps.
    """
    query = torch.arange(past, past + new, device=slopes.device).repeat_interleave(tokens)
    key = torch.arange(past + new, device=slopes.device).repeat_interleave(tokens)
    distance = query[:, None] - key[None, :]
    bias = -slopes[:, None, None] * distance
    return bias.masked_fill(distance < 0, float("-inf"))


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
        self.output_token = nn.Parameter(torch.randn(dim) * 0.02)
        self.blocks = nn.ModuleList(TransformerBlock(dim, heads, dim // heads, mlp_dim) for _ in range(layers))
        self.norm = nn.LayerNorm(dim)
        self.register_buffer("slopes", alibi_slopes(heads), persistent=False)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, list[KeysValues]]:
        """Summaries (B, S, dim) of S new steps' slots (B, S, N, D), and the past for the next call."""
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


MIN_STD, MAX_STD = 0.1, 1.0
"""Range of the actor's standard deviation (DreamerV3's)."""
INITIAL_STD_LOGIT = 2.0
"""Added to the logit of the deviation: an untrained actor starts near MAX_STD and explores."""


def _backbone(config: SOLDConfig, slot_dim: int) -> SlotAggregation:
    return SlotAggregation(slot_dim, config.dim, config.head_layers, config.heads, config.mlp_dim)


class ScalarHead(nn.Module):
    """Reward or value of every step, as logits over a symlog grid; what lies beyond its ends is encoded as the end."""

    grid: Tensor

    def __init__(self, config: SOLDConfig, slot_dim: int) -> None:
        super().__init__()
        self.backbone, self.mean = _backbone(config, slot_dim), config.mean
        self.register_buffer("grid", torch.linspace(-config.limit, config.limit, config.bins), persistent=False)
        self.out = nn.Linear(config.dim, config.bins)
        # Zero logits decode to zero: an untrained head promises nothing (DreamerV3).
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor) -> Tensor:
        """Logits (B, S, bins)."""
        logits: Tensor = self.out(self.backbone(slots)[0])
        return logits

    def decode(self, logits: Tensor) -> Tensor:
        """Logits (..., bins) to values (...)."""
        values: Tensor = (
            two_hot_decode(logits, symexp(self.grid))
            if self.mean == "linear"
            else symexp(two_hot_decode(logits, self.grid))
        )
        return values

    def cross_entropy(self, logits: Tensor, values: Tensor) -> Tensor:
        """Logits (..., bins) and targets (...) to the loss (...); no gradient runs into the targets."""
        loss: Tensor = two_hot_cross_entropy(logits, symlog(values.detach()), self.grid)
        return loss


class ActorHead(nn.Module):
    """Distribution of the action of every step."""

    def __init__(self, config: SOLDConfig, slot_dim: int, action_dim: int) -> None:
        super().__init__()
        self.backbone = _backbone(config, slot_dim)
        self.out = nn.Linear(config.dim, 2 * action_dim)
        # Near zero: the first actions are centred whatever the slots are.
        nn.init.uniform_(self.out.weight, -1e-2, 1e-2)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, Tensor, list[KeysValues]]:
        """Location (B, S, A) in [-1, 1], standard deviation (B, S, A) in [MIN_STD, MAX_STD], and the next past."""
        summary, past = self.backbone(slots, past)
        location, spread = self.out(summary).chunk(2, dim=-1)
        std = MIN_STD + (MAX_STD - MIN_STD) * torch.sigmoid(spread + INITIAL_STD_LOGIT)
        return torch.tanh(location), std, past


def sample_action(distribution: TruncatedNormal, generator: torch.Generator | None) -> Tensor:
    """Reparameterised sample (..., A) in [-1, 1] by the inverse distribution function of a uniform draw.

    TorchRL's own `rsample` takes no generator.
    """
    base = distribution.base_dist
    uniform = torch.rand(base.loc.shape, generator=generator, device=base.loc.device, dtype=base.loc.dtype)
    action: Tensor = base.icdf(uniform)
    return action


class SOLDNetworks(nn.Module):
    """Dynamics, reward, critic and actor; `frames` are those of the longest sequence the dynamics learn from."""

    def __init__(self, config: SOLDConfig, slot_dim: int, action_dim: int, frames: int) -> None:
        super().__init__()
        c = config
        sizes = PredictorConfig(
            kind="ocvp_seq",
            dim=c.dim,
            layers=c.dynamics_layers,
            heads=c.heads,
            head_dim=c.dim // c.heads,
            mlp_dim=c.mlp_dim,
            residual=True,
            context=max(frames, c.context + c.horizon),
        )
        self.dynamics = OCVPSeq(sizes, slot_dim, action_dim)
        self.reward = ScalarHead(c, slot_dim)
        self.critic = ScalarHead(c, slot_dim)
        self.actor = ActorHead(c, slot_dim, action_dim)

    @property
    def parts(self) -> Mapping[str, nn.Module]:
        return {"dynamics": self.dynamics, "reward": self.reward, "critic": self.critic, "actor": self.actor}
