"""Descent through the differentiable rollout: Adam on the latent actions themselves, from several starts at once.

Shapes: M starts, H horizon, Z latent-action width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from playslot_rl.acting.planners.planner import Best, Plan, Search


@dataclass(frozen=True)
class GradientPlanner:
    """Adam in whitened coordinates. The first start is the best plan to begin with, or else the mean latent action
    held; the others lie round it. Iterates are judged by the cost that they have, not by the last step.

    Args:
        candidates: M, starts that descend side by side.
        iterations: steps of Adam; not counted where the search is given seconds.
        learning_rate: in units of the training latents' deviation.
        spread, start_spread: deviation of the other starts, without and with plans to begin with.
        correlation: of the noise of neighbouring steps, 0 to under 1.
    """

    candidates: int = 4
    iterations: int = 30
    learning_rate: float = 0.1
    spread: float = 1.0
    start_spread: float = 0.2
    correlation: float = 0.5

    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        """See `Planner`."""
        best = Best(search)
        first = search.coordinates(best.begin())
        std = search.first_spread(self.spread, self.start_spread)
        drawn = search.around(first, std, self.candidates, self.correlation, generator)
        drawn[0] = first
        with torch.enable_grad():  # a planner is called where actors are: without gradients
            point = drawn.requires_grad_()
            optimiser = torch.optim.Adam([point], lr=self.learning_rate)
            for _ in search.rounds(self.iterations):
                latents = search.latents(point)
                costs = search.cost(latents)
                finite = best.offer(latents, costs).isfinite()
                best.note()
                optimiser.zero_grad()
                # The gradient of the logarithm: Adam's steps then depend on no unit, and huge costs do not overflow.
                relative = costs[finite] / costs[finite].detach().abs().clamp(min=1e-30)
                relative.sum().backward()
                optimiser.step()
                with torch.no_grad():
                    point.clamp_(-search.bound, search.bound)
        last = search.latents(point.detach())
        with torch.no_grad():
            best.offer(last, search.cost(last))
        return best.plan()
