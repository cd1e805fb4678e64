"""What a key press means as a latent action, and who else may steer: the latent policy, or a planner.

    z = p_k + s * d_k

p_k is prototype k. d_k is the direction in which the latents that a video has of this prototype differ most from it
(first principal direction of v = z - p_k, paper, section "InvDyn Module"), one standard deviation long: at s = 1 the
motion differs from the prototype as the videos' own motions commonly do. Latent actions are differences of scene
dynamics, so z = 0 is "nothing moves".

Shapes: K prototypes, Z latent-action width, N slots, P T frames, H W image height and width.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from playslot_rl.acting.planners import CEMPlanner, Search, latent_statistics, shifted
from playslot_rl.acting.planners.costs import DynamicsDistance, GoalCost
from playslot_rl.acting.planning import policy_plan
from playslot_rl.config.planning import PlanConfig
from playslot_rl.errors import CheckpointError
from playslot_rl.frames import to_float
from playslot_rl.modules.policy import LatentPolicy
from playslot_rl.seeds.draws import step_generator
from playslot_rl.world_model import Agent, WorldModel, module_device

if TYPE_CHECKING:
    from playslot_rl.play.session import PlaySession


FEWEST: Final = 8
"""Transitions of a prototype that its own direction needs; with fewer it takes that of all."""
CODEBOOK_SHARE: Final = 0.25
"""Length of the direction, as a share of the prototypes' spread, where there are no videos."""


class Driver(Protocol):
    """Whoever may take over: the latent policy, or a planner; the page shows its title."""

    title: str

    def choose(self, session: PlaySession) -> Tensor:
        """The next latent action ([N,] Z) for where the session stands; the session is left as it is."""


class PolicyDriver:
    """The latent policy: slots (..., N, D) to a latent action (..., Z), in evaluation mode; one that is shown goals
    heads for the planner's, one of several tasks is told the `task` of this number.
    """

    def __init__(
        self, policy: LatentPolicy, planner: PlannerDriver, task: int | None = None, title: str = "latent policy"
    ) -> None:
        self.policy, self.planner, self.task, self.title = policy, planner, task, title

    @torch.no_grad()
    def choose(self, session: PlaySession) -> Tensor:
        slots = (_whole(session) if self.policy.goal else session.slots)[None]
        told = [self.planner.marked()[None]] if self.policy.goal else []
        if self.task is not None:
            told = [torch.tensor([[self.task]], device=slots.device)]
        chosen: Tensor = self.policy(slots, *told)[0]
        return chosen


def policy_drivers(agent: Agent, planner: PlannerDriver) -> dict[str, Driver]:
    """The latent policy, by name; of several tasks one for each."""
    if not agent.policy.tasks:
        return {"policy": PolicyDriver(agent.policy, planner)}
    return {
        f"policy: {task}": PolicyDriver(agent.policy, planner, number, f"latent policy: {task}")
        for number, task in enumerate(agent.world_model.env.tasks)
    }


def require_prototypes(model: WorldModel) -> Tensor:
    """The codebook (K, Z); a CheckpointError where the world model's latent actions have none."""
    mode = model.config.inverse_dynamics.mode
    if mode not in ("hybrid", "discrete"):
        raise CheckpointError(
            f"play: got a world model of latent-action mode {mode}, expected hybrid or discrete: it has no prototypes "
            "to steer by; train dynamics with model.inverse_dynamics.mode=hybrid"
        )
    return model.inverse_dynamics.prototypes


@torch.no_grad()
def variability_directions(model: WorldModel, clips: npt.NDArray[np.uint8] | None) -> Tensor:
    """The direction (K, Z) of each prototype's variability, one standard deviation long, in videos uint8 (n, T, H, W,
    3). Without videos every prototype has the principal direction of the codebook, CODEBOOK_SHARE of the prototypes'
    spread along it. A CheckpointError where there are no prototypes.
    """
    prototypes = require_prototypes(model)
    if clips is None or clips.shape[1] < 2:
        return (CODEBOOK_SHARE * _principal(prototypes)).expand(len(prototypes), -1).clone()
    latents = model.inverse_dynamics(model.savi.parse(to_float(clips, module_device(model))))
    code, z = latents.code.flatten(), latents.z.flatten(0, -2)
    difference = z - prototypes[code]
    overall = _principal(difference)
    return torch.stack(
        [
            _principal(difference[code == k]) if int((code == k).sum()) >= FEWEST else overall
            for k in range(len(prototypes))
        ]
    )


def _principal(rows: Tensor) -> Tensor:
    """First principal direction of rows (M, Z), one deviation long; its largest number is positive."""
    centred = rows - rows.mean(dim=0)
    _, strength, directions = torch.linalg.svd(centred.double(), full_matrices=False)
    first = directions[0] * strength[0] / max(1, len(rows) - 1) ** 0.5
    sign = torch.sign(first[first.abs().argmax()])
    out: Tensor = (first * torch.where(sign == 0, torch.ones_like(sign), sign)).to(rows.dtype)
    return out


HORIZON: Final = 8
CANDIDATES: Final = 24
ITERATIONS: Final = 3
ELITES: Final = 6
"""A search that a player waits for: well under a second on one core."""


class PlannerDriver:
    """Steers to a goal, the slots (N, D) of a moment that the player has marked, by the cross-entropy method; with one
    latent for all slots.

        z_{1:H} = argmin d(S^_H, S_goal),   of which the first is taken, and the rest begins the next search

    The search begins with the latent policy's rollout, so that what it finds costs no more in imagination than what the
    policy would do (`playslot_rl.acting.planners`), unless that would have to be told which of several tasks to do.
    """

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
        """Mark the session's present moment as the goal; a ValueError where a slot was removed from it."""
        self.goal, self._last = _whole(session), None

    def marked(self) -> Tensor:
        """The goal; a ValueError where none is marked."""
        if self.goal is None:
            raise ValueError("goal: got none, expected a marked moment: go to one and press Goal, then go back")
        return self.goal

    @torch.no_grad()
    def choose(self, session: PlaySession) -> Tensor:
        """The plan's first latent action (Z,) at the present slots; a ValueError where no goal is marked."""
        goal, policy = self.marked(), self.agent.policy
        slots, model = _whole(session), self.agent.world_model
        distance = DynamicsDistance(model.inverse_dynamics, policy.whitening or self._whitening, goal)
        past = slots.new_empty(0, *model.latent_shape)
        cost = GoalCost(model, slots[None], past, distance, self._along)
        starts = slots.new_empty(0, HORIZON, *model.latent_shape)
        if not policy.tasks:
            starts = policy_plan(self.agent, slots, HORIZON, goal)
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


SHARE: Final = 0.45
"""Of the spread. Prototypes of the shipped models that nobody can tell apart are up to 0.4 of it apart, others 0.55."""
FLOOR: Final = 0.5
"""Of 255: nobody sees it."""


def alike(frames: npt.NDArray[np.uint8]) -> dict[int, int]:
    """The prototypes that do the same as one of a smaller number, by that number, which is like none before it; from
    what holding each shows, uint8 (K, P, H, W, 3).

        j ~ k  where  |x_j - x_k| <= max(SHARE * spread, FLOOR),    spread^2 = mean_k |x_k - mean x|^2

    |.| is the root mean square over frames and pixels. Against the spread, since what counts as the same is a matter of
    how far apart the others are; not below a floor, since prototypes that all do nothing are the same although they
    have none.
    """
    seen = frames.reshape(len(frames), -1).astype(np.float32)
    spread = float(np.sqrt(np.square(seen - seen.mean(0)).mean()))
    near, found, unlike = max(SHARE * spread, FLOOR), dict[int, int](), list[int]()
    for number, own in enumerate(seen):
        same = [other for other in unlike if float(np.sqrt(np.square(own - seen[other]).mean())) <= near]
        if same:
            found[number] = same[0]
        else:
            unlike.append(number)
    return found


def in_words(found: Mapping[int, int]) -> str:
    """What `alike` found as a line for the page; empty where all differ."""
    groups: dict[int, list[str]] = {}
    for number, other in found.items():
        groups.setdefault(other, []).append(str(number))
    said = []
    for other, numbers in groups.items():
        listed = numbers[0] if len(numbers) == 1 else f"{', '.join(numbers[:-1])} and {numbers[-1]}"
        said.append(f"{listed} {'does' if len(numbers) == 1 else 'do'} the same as {other}")
    return f"from here, {'; '.join(said)}" if said else ""
