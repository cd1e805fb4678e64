"""Model-predictive path integral control: the next mean is the average of all candidates, weighted by their cost.

    w_i = softmax(-(J_i - min J) / (temperature * scale)),   mu <- sum_i w_i c_i

The exponent is shifted by the least cost and measured in units of the candidates' own spread of costs, so it neither
underflows nor depends on the unit of the cost: costs of 1e30 and infinite ones give weights, not NaN.

Shapes: M candidates, H horizon, Z latent-action width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from playslot_rl.acting.planners.planner import Best, Plan, Search


@dataclass(frozen=True)
class MPPIPlanner:
    """MPPI in whitened coordinates.

    Args:
        iterations: of drawing and averaging; not counted where the search is given seconds.
        temperature: in units of the standard deviation of the candidates' costs; small follows the best alone.
        spread, start_spread: standard deviation of the noise, without and with plans to begin with.
        floor: least standard deviation.
        decay: factor of the deviation from iteration to iteration.
        correlation: of the noise of neighbouring steps, 0 to under 1.
    """

    candidates: int = 64
    iterations: int = 10
    temperature: float = 0.2
    spread: float = 1.0
    start_spread: float = 0.2
    floor: float = 0.05
    decay: float = 0.8
    correlation: float = 0.5

    @torch.no_grad()
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        """See `Planner`."""
        best = Best(search)
        mean = search.coordinates(best.begin())
        std = search.first_spread(self.spread, self.start_spread)
        for _ in search.rounds(self.iterations):
            drawn = search.around(mean, std, self.candidates, self.correlation, generator)
            tried = torch.cat([drawn, mean[None], search.coordinates(best.latents)[None]])
            latents = search.latents(tried)
            weights = path_weights(best.offer(latents, search.cost(latents)), self.temperature)
            mean = torch.tensordot(weights, tried, 1)
            std = max(self.decay * std, self.floor)
            best.note()
        last = search.latents(mean)[None]
        best.offer(last, search.cost(last))
        return best.plan()


def path_weights(costs: Tensor, temperature: float) -> Tensor:
    """Weights (M,) that sum to one, largest for the least cost; costs (M,) may be infinite, but not all of them.

    Examples:
        >>> path_weights(torch.tensor([1e30, 2e30, float("inf")]), 0.2).sum().item()
        1.0
    """
    costs = costs.double()  # squares of 1e30 overflow in single precision
    finite = costs.isfinite()
    if not bool(finite.any()):
        return torch.full_like(costs, 1 / len(costs)).float()
    known = costs[finite]
    scale = known.std(unbiased=False).clamp(min=1e-12 * known.abs().max().clamp(min=1e-12))
    return torch.softmax(-(costs - known.min()) / (temperature * scale), 0).float()
