"""Model-based offline planning (Argenson and Dulac-Arnold, ICLR 2021): the policy, shaken, proposes all candidates.

    z_t = pi(S^_t) + sigma e_t,   S^_{t+1} = cOCVP(S^_{<=t}, z_{<=t}),   e_t ~ N(0, 1) in whitened coordinates,
    plan = sum_i w_i c_i,         w = softmax(-(J - min J) / (temperature * scale))

The other planners shake a plan as a whole, and what follows a step that went elsewhere is no longer what the policy
would do there. Here the policy answers at every imagined step, so that candidates stay where demonstrations were.

Note: the paper weights by rewards, mixes each step with the last plan's and takes the average; here the last plan is
tried as it is, and what is returned is the best of all that was tried, the average among it.

Shapes: M candidates, H horizon, Z latent-action width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from playslot_rl.acting.planners.mppi import path_weights
from playslot_rl.acting.planners.planner import Best, Plan, Search


@dataclass(frozen=True)
class MBOPPlanner:
    """Rollouts of the shaken policy, averaged by their cost.

    Args:
        candidates: M, rollouts in an iteration.
        iterations: of rolling out; not counted where the search is given seconds.
        temperature: in units of the standard deviation of the candidates' costs; small follows the best alone.
        spread: sigma of the first iteration, in units of the training latents'.
        floor: least sigma.
        decay: factor of sigma from iteration to iteration.
    """

    candidates: int = 64
    iterations: int = 4
    temperature: float = 0.2
    spread: float = 0.5
    floor: float = 0.05
    decay: float = 0.8

    @torch.no_grad()
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        """See `Planner`.

        Raises:
            ValueError: the search has no policy.
        """
        if search.policy is None:
            raise ValueError("planner=mbop: got no policy, which makes its candidates: use proposal=policy")
        best = Best(search)
        best.begin()
        spread = self.spread
        for _ in search.rounds(self.iterations):
            drawn = search.policy(self.candidates, spread, generator)
            costs = best.offer(drawn, search.cost(drawn))
            mean = torch.tensordot(path_weights(costs, self.temperature), drawn, 1)[None]
            best.offer(mean, search.cost(mean))
            spread = max(self.decay * spread, self.floor)
            best.note()
        return best.plan()
