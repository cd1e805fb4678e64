"""The cross-entropy method over prototypes: every step has a categorical distribution over the K codes.

    k_t ~ Cat(pi_t),   pi_t <- (1 - s) * (the elites' frequencies at t) + s / K

A plan is a sequence of prototypes, variability zero: K^H of them, the moves a player has with the number keys.

Shapes: M candidates, H horizon, K prototypes, Z latent-action width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from playslot_rl.acting.planners.planner import Best, Plan, Search


@dataclass(frozen=True)
class PrototypePlanner:
    """Categorical CEM over prototypes (K, Z). Plans to begin with are candidates as they are, and the first
    distribution leans to the prototypes nearest to the best of them.

    Args:
        iterations: of drawing and counting; not counted where the search is given seconds.
        elites: how many are counted.
        floor: s, part of the probability that stays spread evenly.
        lean: part of the first distribution on the prototypes of a plan to begin with.

    Examples:
        >>> from playslot_rl.modules.whitening import Whitening
        >>> search = Search(lambda z: (z - 2.0).square().sum((1, 2)), (3, 1), Whitening(1), torch.empty(0, 3, 1))
        >>> planner = PrototypePlanner(torch.tensor([[0.0], [1.0], [2.0]]))
        >>> planner(search, torch.Generator().manual_seed(0)).latents.flatten().tolist()
        [2.0, 2.0, 2.0]
    """

    prototypes: Tensor
    candidates: int = 64
    iterations: int = 10
    elites: int = 8
    floor: float = 0.05
    lean: float = 0.5

    @torch.no_grad()
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        """See `Planner`."""
        best, k = Best(search), len(self.prototypes)
        first = best.begin()
        steps = search.shape[:-1]
        probabilities = torch.full((*steps, k), 1 / k, device=self.prototypes.device)
        if len(search.starts):
            near = torch.cdist(first.reshape(-1, first.shape[-1]), self.prototypes).argmin(-1).reshape(steps)
            probabilities = (1 - self.lean) * probabilities + self.lean * F.one_hot(near, k)
        kept = torch.empty(0, *steps, dtype=torch.long, device=self.prototypes.device)
        for _ in search.rounds(self.iterations):
            drawn = torch.multinomial(
                probabilities.reshape(-1, k), self.candidates, replacement=True, generator=generator
            )
            tried = torch.cat([drawn.T.reshape(-1, *steps), kept])
            latents = self.prototypes[tried]
            costs = best.offer(latents, search.cost(latents))
            kept = tried[costs.topk(min(self.elites, len(tried)), largest=False).indices]
            probabilities = (1 - self.floor) * F.one_hot(kept, k).float().mean(0) + self.floor / k
            best.note()
        return best.plan()
