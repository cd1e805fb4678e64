"""The cross-entropy method with a Gaussian: draw candidates, keep the elites, draw from what they have in common.

    c ~ N(mu, sigma^2),   mu, sigma <- mean and deviation of the K elites,   sigma >= floor

As in iCEM (Pinneri et al., 2020) the elites stay among the candidates of the next iteration, so the best cost never
rises, and the noise may be correlated over the steps: neighbouring steps of a motion resemble each other.

Shapes: M candidates, K elites, H horizon, Z latent-action width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from playslot_rl.acting.planners.planner import Best, Plan, Search


@dataclass(frozen=True)
class CEMPlanner:
    """Cross-entropy method in whitened coordinates.

    Args:
        candidates: M, plans drawn in an iteration.
        iterations: of drawing and fitting; not counted where the search is given seconds.
        elites: K, at most M.
        spread, start_spread: first standard deviation, as of the training latents, without and with plans to begin
            with.
        floor: least standard deviation.
        correlation: of the noise of neighbouring steps, 0 to under 1.

    Examples:
        >>> from playslot_rl.modules.whitening import Whitening
        >>> goal = torch.tensor([[1.0, -1.0], [0.5, 0.0]])
        >>> search = Search(lambda z: (z - goal).square().sum((1, 2)), (2, 2), Whitening(2), torch.empty(0, 2, 2))
        >>> CEMPlanner()(search, torch.Generator().manual_seed(0)).cost < 1e-2
        True
    """

    candidates: int = 64
    iterations: int = 10
    elites: int = 8
    spread: float = 1.0
    start_spread: float = 0.2
    floor: float = 0.05
    correlation: float = 0.5

    @torch.no_grad()
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        """See `Planner`."""
        best = Best(search)
        mean = search.coordinates(best.begin())
        std = torch.full_like(mean, search.first_spread(self.spread, self.start_spread))
        kept = mean.new_empty(0, *search.shape)
        for _ in search.rounds(self.iterations):
            mean, std, kept = self._improve(search, best, mean, std, kept, generator)
            best.note()
        return best.plan()

    def _improve(
        self, search: Search, best: Best, mean: Tensor, std: Tensor, kept: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One iteration: mean and deviation (H, [N,] Z) and elites (K, H, [N,] Z), in whitened coordinates."""
        drawn = search.around(mean, std, self.candidates, self.correlation, generator)
        tried = torch.cat([drawn, mean[None], kept])  # at first the mean is the best plan to begin with
        latents = search.latents(tried)
        costs = best.offer(latents, search.cost(latents))
        elites = tried[costs.topk(min(self.elites, len(tried)), largest=False).indices]
        return elites.mean(0), elites.std(0, unbiased=False).clamp(min=self.floor), elites
