"""A search by each planner that ships, through a tiny world model, towards a goal by all three distances at once."""

from __future__ import annotations

from typing import get_args

import torch
from torch import Tensor

from playslot_rl.acting.planners import Planner, Search, build_planner, latent_statistics, search_size
from playslot_rl.acting.planners.costs import GoalCost, NearProposal, goal_distance
from playslot_rl.config import PlanConfig
from playslot_rl.config.planning import CostName, PlannerName
from playslot_rl.testing import tiny_agent

PLAN = PlanConfig(horizon=3, every=1, candidates=6, iterations=3, elites=2, descents=2)


def tiny_search(name: PlannerName, device: str = "cpu") -> tuple[Planner, Search]:
    """The planner, and a search that begins with a proposal and has to stay near it."""
    agent = tiny_agent().requires_grad_(False).to(device)
    model, whitening = agent.world_model, latent_statistics(agent)
    shape = (3, *model.latent_shape)

    def drawn(seed: int, *of: int) -> Tensor:
        return torch.randn(of, generator=torch.Generator().manual_seed(seed)).to(device)

    start, goal = drawn(0, 1, *model.slot_shape), drawn(1, *model.slot_shape)
    image, proposal, past = drawn(2, 3, 64, 64).sigmoid(), drawn(3, *shape), drawn(4, 0, *model.latent_shape)
    costs = [GoalCost(model, start, past, goal_distance(agent, kind, goal, image)) for kind in get_args(CostName)]
    near = NearProposal(lambda z: torch.stack([cost(z) for cost in costs]).sum(0), proposal, whitening, 3.0)
    planner = build_planner(name, PLAN, search_size(PLAN, "solved", 5), model)
    return planner, Search(near, shape, whitening, proposal[None])
