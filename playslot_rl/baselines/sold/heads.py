"""SOLD's reward, value and actor: a slot-aggregation transformer each, and a linear layer
(Mosbach et al., 2025, section 3.3).

Shapes: slots (B, S, N, D), A action width. All take the past that they returned for the earlier steps, so a step of
imagination costs one step.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torchrl.modules import TruncatedNormal

from playslot_rl.baselines.sold.aggregation import SlotAggregation
from playslot_rl.baselines.sold.two_hot import SymlogTwoHot
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
        two_hot: its categories.
    """

    def __init__(self, backbone: SlotAggregation, dim: int, two_hot: SymlogTwoHot) -> None:
        super().__init__()
        self.backbone, self.two_hot = backbone, two_hot
        self.out = nn.Linear(dim, len(two_hot.grid))
        # Zero logits decode to zero: an untrained head promises nothing (DreamerV3).
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def forward(self, slots: Tensor) -> Tensor:
        """Logits (B, S, bins)."""
        logits: Tensor = self.out(self.backbone(slots)[0])
        return logits

    def decode(self, logits: Tensor) -> Tensor:
        """Logits (..., bins) to values (...)."""
        return self.two_hot.decode(logits)

    def cross_entropy(self, logits: Tensor, values: Tensor) -> Tensor:
        """Logits (..., bins) and targets (...) to the loss (...); no gradient runs into the targets."""
        return self.two_hot.cross_entropy(logits, values.detach())


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
