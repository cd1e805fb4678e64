"""One search for a plan towards a goal's slots, with the shipped ButtonPress model: our CEM on the cached rollout, and
TorchRL's in the imagination environment. Both predict as many steps: M candidates, H steps, I iterations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from playslot_rl.speed.cases import Sizes, Step, Variant

if TYPE_CHECKING:
    from playslot_rl.acting.planners.costs import Distance
    from playslot_rl.modules.whitening import Whitening
    from playslot_rl.world_model import WorldModel


def plan_variants() -> dict[str, Variant]:
    """TorchRL's planner, and our own; in fp32, as `playslot plan` runs."""
    return {name: Variant("plan_step", precision="fp32", cached=name == "own") for name in ("torchrl", "own")}


def plan_step(variant: Variant, sizes: Sizes) -> Step:
    """The search to be timed; it gives the largest latent of the plan.

    Args:
        variant: `cached` takes our planner.
        sizes: `plan_candidates` M, `plan_horizon` H, `plan_iterations` I, of M `plan_elites` are kept.
    """
    from playslot_rl.acting.planners import latent_statistics
    from playslot_rl.acting.planners.costs import SlotDistance
    from playslot_rl.runs import Run

    agent = Run.open("pretrained").load_agent()
    agent.world_model.eval().requires_grad_(False)
    start, goal = torch.randn(2, *agent.world_model.slot_shape)
    make = _own if variant.cached else _torchrl
    return torch.no_grad()(make(agent.world_model, latent_statistics(agent), start, SlotDistance(goal), sizes))


def _own(model: WorldModel, statistics: Whitening, start: Tensor, distance: Distance, sizes: Sizes) -> Step:
    from playslot_rl.acting.planners import CEMPlanner, Search
    from playslot_rl.acting.planners.costs import GoalCost

    shape, generator = (sizes.plan_horizon, *model.latent_shape), torch.Generator().manual_seed(0)
    nothing = torch.empty(0, *shape)  # to begin with
    past = torch.empty(0, *model.latent_shape)
    planner = CEMPlanner(sizes.plan_candidates, sizes.plan_iterations, sizes.plan_elites)

    def step() -> Tensor:
        cost = GoalCost(model, start[None], past, distance)
        return planner(Search(cost, shape, statistics, nothing), generator).latents.abs().max()

    return step


def _torchrl(model: WorldModel, statistics: Whitening, start: Tensor, distance: Distance, sizes: Sizes) -> Step:
    from torchrl.modules.planners import CEMPlanner

    from playslot_rl.acting.planners.torchrl_planning import latent_of, planning_env, planning_start

    env = planning_env(model, distance, statistics, sizes.plan_horizon)
    planner = CEMPlanner(
        env,
        planning_horizon=sizes.plan_horizon,
        optim_steps=sizes.plan_iterations,
        num_candidates=sizes.plan_candidates,
        top_k=sizes.plan_elites,
    )

    def step() -> Tensor:
        return latent_of(statistics, planner(planning_start(env, start))["action"]).abs().max()

    return step
