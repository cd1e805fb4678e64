"""Planners: searches for the latent actions that lead to a goal image, behind one protocol, and the choice among them.

`playslot_rl.acting.planning` acts by them in the simulator; `torchrl_planning` is the way in for TorchRL's own.
"""

from __future__ import annotations

from dataclasses import dataclass

from playslot_rl.acting.planners.planner import Cost, Plan, Planner, Search, latent_statistics, shifted
from playslot_rl.acting.planners.searches import CEMPlanner, GradientPlanner, MPPIPlanner, PrototypePlanner
from playslot_rl.config.plain import check
from playslot_rl.config.planning import GoalName, PlanConfig, PlannerName
from playslot_rl.errors import ConfigError
from playslot_rl.world_model import WorldModel

__all__ = [
    "CEMPlanner",
    "Cost",
    "GradientPlanner",
    "MPPIPlanner",
    "Plan",
    "Planner",
    "PrototypePlanner",
    "Search",
    "SearchSize",
    "build_planner",
    "latent_statistics",
    "search_size",
    "shifted",
]


@dataclass(frozen=True)
class SearchSize:
    """The six keys of `PlanConfig` that the goals decide, with nothing left open."""

    horizon: int
    every: int
    candidates: int
    iterations: int
    elites: int
    prior: float


def search_size(plan: PlanConfig, goals: GoalName, frame_skip: int) -> SearchSize:
    """How large a search is, and how near to the policy it stays: what was typed, else the goals' own.

    stable-worldmodel plans 5 blocks of 5 environment steps, all of them executed before the next plan, with 300
    samples, 30 iterations and 30 elites. Our agent step is a block of `frame_skip` environment steps. A policy that was
    cloned from the task's demonstrations means the goals `solved`, and plans from it stay near it; it does not mean the
    goals `ahead`.

    A ValueError for more elites than candidates, or more steps executed than planned.
    """
    blocks = max(1, round(25 / frame_skip))
    own = SearchSize(16, 2, 64, 8, 8, 3.0) if goals == "solved" else SearchSize(blocks, blocks, 300, 30, 30, 0.0)
    horizon = plan.horizon or own.horizon
    candidates = plan.candidates or own.candidates
    every, elites = plan.every or min(own.every, horizon), plan.elites or min(own.elites, candidates)
    check(every <= horizon, "plan.every", every, f"at most plan.horizon={horizon}")
    check(elites <= candidates, "plan.elites", elites, f"at most the {candidates} candidates")
    prior = own.prior if plan.prior is None else plan.prior
    return SearchSize(horizon, every, candidates, plan.iterations or own.iterations, elites, prior)


def build_planner(name: PlannerName, plan: PlanConfig, size: SearchSize, world_model: WorldModel) -> Planner:
    """A planner by its name; a ConfigError for `prototypes` with a world model that has none."""
    c, n = plan, size
    if name == "gradient":
        return GradientPlanner(c.descents, n.iterations, c.learning_rate, c.spread, c.start_spread, c.correlation)
    if name == "prototypes":
        if not world_model.inverse_dynamics.n_prototypes:
            mode = world_model.config.inverse_dynamics.mode
            raise ConfigError(f"planner=prototypes: got a world model of mode {mode}, which has none; use planner=cem")
        prototypes = world_model.inverse_dynamics.prototypes
        return PrototypePlanner(prototypes, n.candidates, n.iterations, n.elites, c.floor)
    noise = (c.spread, c.start_spread, c.floor)
    if name == "mppi":
        return MPPIPlanner(n.candidates, n.iterations, c.temperature, *noise, correlation=c.correlation)
    return CEMPlanner(n.candidates, n.iterations, n.elites, *noise, c.correlation)
