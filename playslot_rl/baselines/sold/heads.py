"""SOLD's reward, value and actor: a slot-aggregation transformer each, and a linear layer
(Mosbach et al., 2025, section 3.3). Scalars are categories on a symlog grid (Hafner et al., 2023):

    target: two-hot(symlog(x)),   p = softmax(l),   b_k evenly spaced in [-limit, limit]
    decoded, linear: x^ = sum_k p_k symexp(b_k)      decoded, symlog: x^ = symexp(sum_k p_k b_k)

Note: the linear mean is the source's and unbiased. On its grid of +-20, values of up to 4.9e8, TorchRL's
`SymExpTwoHot` is the same. But SOLD's actor is trained through decoded rewards and values, where the gradient of a bin
of 4.9e8 drowns all others. So either the grid ends where returns do, or the mean is taken in symlog, which stays of
the size of the value and is too low where the head is uncertain (between 10 and 200 it says 46, not 105).

Shapes: slots (B, S, N, D), A action width. All take the past that they returned for the earlier steps, so a step of
imagination costs one step.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor, nn
from torchrl.modules import TruncatedNormal, symexp, symlog
from torchrl.objectives import two_hot_cross_entropy, two_hot_decode

from playslot_rl.baselines.sold.aggregation import SlotAggregation
from playslot_rl.modules.transformer import KeysValues

MIN_STD, MAX_STD = 0.1, 1.0
"""Range of the actor's standard deviation (DreamerV3's)."""
INITIAL_STD_LOGIT = 2.0
"""Added to the logit of the deviation: an untrained actor starts near MAX_STD and explores."""


class ScalarHead(nn.Module):
    """Reward or value of every step, as logits over a symlog grid.

    Args:
        backbone: the slot-aggregation transformer.
        dim: its width.
        bins: categories; odd, so that one of them is zero.
        limit: the grid's ends, in symlog; what lies beyond is encoded as the end.
        mean: how probabilities become a value.

    Raises:
        ValueError: bins even, or fewer than 3.
    """

    grid: Tensor

    def __init__(
        self,
        backbone: SlotAggregation,
        dim: int,
        bins: int,
        limit: float = 20.0,
        mean: Literal["symlog", "linear"] = "symlog",
    ) -> None:
        super().__init__()
        if bins < 3 or bins % 2 == 0:
            raise ValueError(f"bins: got {bins}, expected an odd number from 3 on")
        self.backbone, self.mean = backbone, mean
        self.register_buffer("grid", torch.linspace(-limit, limit, bins), persistent=False)
        self.out = nn.Linear(dim, bins)
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
    """Distribution of the action of every step.

    Args:
        backbone: the slot-aggregation transformer.
        dim: its width.
        action_dim: A.
    """

    def __init__(self, backbone: SlotAggregation, dim: int, action_dim: int) -> None:
        super().__init__()
        self.backbone = backbone
        self.out = nn.Linear(dim, 2 * action_dim)
        # Near zero: the first actions are centred whatever the slots are.
        nn.init.uniform_(self.out.weight, -1e-2, 1e-2)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor, past: list[KeysValues] | None = None) -> tuple[Tensor, Tensor, list[KeysValues]]:
        """Location (B, S, A) in [-1, 1], standard deviation (B, S, A) in [MIN_STD, MAX_STD], and the next past."""
        summary, past = self.backbone(slots, past)
        location, spread = self.out(summary).chunk(2, dim=-1)
        std = MIN_STD + (MAX_STD - MIN_STD) * torch.sigmoid(spread + INITIAL_STD_LOGIT)
        return torch.tanh(location), std, past


def action_distribution(location: Tensor, std: Tensor) -> TruncatedNormal:
    """Normal truncated to [-1, 1] in every dimension, (..., A); its mode is the location."""
    return TruncatedNormal(location, std)


def sample_action(distribution: TruncatedNormal, generator: torch.Generator | None) -> Tensor:
    """Reparameterised sample (..., A) in [-1, 1] by the inverse distribution function of a uniform draw.

    TorchRL's own `rsample` takes no generator.
    """
    base = distribution.base_dist
    uniform = torch.rand(base.loc.shape, generator=generator, device=base.loc.device, dtype=base.loc.dtype)
    action: Tensor = base.icdf(uniform)
    return action
