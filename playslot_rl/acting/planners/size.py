"""How large a search is, and how near to the policy it stays: what was typed, else what the goals ask for."""

from __future__ import annotations

from dataclasses import dataclass

from playslot_rl.config.plain import check
from playslot_rl.config.planning import GoalName, PlanConfig


@dataclass(frozen=True)
class SearchSize:
    """The six keys that the goals decide, with nothing left open; as in `PlanConfig`."""

    horizon: int
    every: int
    candidates: int
    iterations: int
    elites: int
    prior: float


def search_size(plan: PlanConfig, goals: GoalName, frame_skip: int) -> SearchSize:
    """The size of a search: what was typed, else the goals' own.

    stable-worldmodel plans 5 blocks of 5 environment steps, all of them executed before the next plan, with 300
    samples, 30 iterations and 30 elites. Our agent step is a block of `frame_skip` environment steps.

    A policy that was cloned from the task's demonstrations means the goals `solved`, and plans from it stay near it; it
    does not mean the goals `ahead`.

    Raises:
        ValueError: more elites than candidates, or more steps executed than planned.
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
