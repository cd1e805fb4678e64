"""A planner that takes over: it steers the imagined scene to a moment that the player has marked as the goal.

    z_{1:H} = argmin d(S^_H, S_goal),   of which the first is taken, and the rest begins the next search

The search begins with the latent policy's rollout, so that what it finds costs no more in imagination than what the
policy would do (`playslot_rl.acting.planners`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import torch
from torch import Tensor

from playslot_rl.acting.planners import CEMPlanner, Search, latent_statistics, shifted
from playslot_rl.acting.planners.costs import DynamicsDistance, GoalCost
from playslot_rl.acting.planning import policy_plan
from playslot_rl.config.planning import PlanConfig
from playslot_rl.seeds.draws import step_generator
from playslot_rl.world_model import Agent

if TYPE_CHECKING:
    from playslot_rl.play.session import PlaySession

HORIZON: Final = 8
CANDIDATES: Final = 24
ITERATIONS: Final = 3
ELITES: Final = 6
"""A search that a player waits for: well under a second on one core."""


class PlannerDriver:
    """Plans to a goal, the slots (N, D) of a moment, with the cross-entropy method; with one latent for all slots."""

    title = "planner"

    def __init__(self, agent: Agent) -> None:
        self.agent = agent
        self.goal: Tensor | None = None
        self._whitening, own = latent_statistics(agent), PlanConfig()
        self._planner = CEMPlanner(
            CANDIDATES, ITERATIONS, ELITES, own.spread, own.start_spread, own.floor, own.correlation
        )
        self._bound, self._along = own.bound, own.along
        self._last: tuple[int, Tensor] | None = None

    def aim(self, session: PlaySession) -> None:
        """Mark the session's present moment as the goal.

        Raises:
            ValueError: a slot was removed from it.
        """
        self.goal, self._last = _whole(session), None

    @torch.no_grad()
    def choose(self, session: PlaySession) -> Tensor:
        """The plan's first latent action (Z,) at the present slots.

        Raises:
            ValueError: no goal is marked, or a slot was removed.
        """
        if self.goal is None:
            raise ValueError("planner: got no goal, expected a marked moment: go to one and press Goal, then go back")
        slots, model = _whole(session), self.agent.world_model
        distance = DynamicsDistance(model.inverse_dynamics, self.agent.policy.whitening or self._whitening, self.goal)
        past = slots.new_empty(0, *model.latent_shape)
        cost = GoalCost(model, slots[None], past, distance, self._along)
        starts = policy_plan(self.agent, slots, HORIZON)
        now = session.now
        if self._last is not None and self._last[0] == now.parent:
            starts = torch.cat([starts, shifted(self._last[1], 1, self._whitening.mean)[None]])
        search = Search(cost, (HORIZON, *model.latent_shape), self._whitening, starts, self._bound)
        plan = self._planner(search, step_generator(0, now.number, "play-planner", slots.device))
        self._last = (now.number, plan.latents)
        return plan.latents[0]


def _whole(session: PlaySession) -> Tensor:
    slots, expected = session.slots, session.world_model.slot_shape
    if tuple(slots.shape) != expected:
        raise ValueError(
            f"planner: got {len(slots)} slots, expected all {expected[0]}: undo what was removed, or steer yourself"
        )
    return slots
