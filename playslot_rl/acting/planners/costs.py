"""What a plan costs: how far the imagined future is from a goal image, in slots or in pixels.

    J(z_{1:H}) = (1 - a) d(S^_H, G) + a / H sum_t d(S^_t, G),   d(S, G) = min_pi 1/ND sum_n |S_n - G_pi(n)|^2

with the weight a of the way (`along`): 0 asks where the plan ends, 1 also how soon it is there. All candidates' futures
come from the cached rollout at once; what was seen before the plan begins may be given as seed frames.

Shapes: M candidates, H horizon, S seed frames, N slots, D slot width, Z latent-action width, W H image size. "[N,]" is
there with one latent action per slot.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from playslot_rl.acting.planners.planner import Cost, latent_statistics
from playslot_rl.config.planning import CostName
from playslot_rl.frames import normalise
from playslot_rl.modules.inverse_dynamics import InverseDynamics
from playslot_rl.modules.savi import SAVi
from playslot_rl.modules.whitening import Whitening
from playslot_rl.world_model import Agent, WorldModel

Distance = Callable[[Tensor], Tensor]
"""Slots (..., N, D) to how far each frame is from the goal (...)."""


class SlotDistance:
    """Mean squared difference of slots to the goal's (N, D).

    With `match` the order of the slots is free: each frame is then matched with the goal by the Hungarian algorithm.
    Learned initial slots keep their order, and matching only lets things change places.

    Examples:
        >>> goal = torch.tensor([[0.0, 1.0], [2.0, 3.0]])
        >>> float(SlotDistance(goal)(goal.flip(0))), float(SlotDistance(goal, match=True)(goal.flip(0)))
        (4.0, 0.0)
    """

    def __init__(self, goal: Tensor, match: bool = False) -> None:
        self.goal, self.match = goal, match

    def __call__(self, slots: Tensor) -> Tensor:
        if not self.match:
            return (slots - self.goal).square().mean((-2, -1))
        flat = slots.reshape(-1, *self.goal.shape)
        pairs = (flat[:, :, None] - self.goal).square().mean(-1)  # (M, N, N): predicted slot, goal slot
        return pairs.gather(2, assignment(pairs)[..., None]).mean((1, 2)).reshape(slots.shape[:-2])


@torch.no_grad()
def assignment(pairs: Tensor) -> Tensor:
    """Which goal slot (M, N) each slot is matched with, so that the sum of the pairs' costs (M, N, N) is least."""
    from scipy.optimize import linear_sum_assignment

    costs = np.nan_to_num(pairs.double().cpu().numpy(), nan=1e300, posinf=1e300)
    return torch.from_numpy(np.stack([linear_sum_assignment(cost)[1] for cost in costs])).to(pairs.device)


class DynamicsDistance:
    """Mean squared difference of the scene dynamics to those of goal slots (N, D), in whitened latent actions.

        d(S, G) = 1/Z |W^-1 (mu(S) - mu(G))|^2

    A latent action is a difference of InvDyn's means, z_t = mu_{t+1} - mu_t, so mu(G) - mu(S) is the sum of the latent
    actions that lead from S to G, and W^-1 counts it in steps of a typical motion. Slots saturate: once an object is
    out of the place where the goal has it, they no longer say how far (docs/how-to/plan.md). A ValueError where InvDyn
    has no encoder (modes `ground_truth` and `none`).
    """

    def __init__(self, inverse_dynamics: InverseDynamics, whitening: Whitening, goal: Tensor) -> None:
        mode = inverse_dynamics.config.mode
        if mode in ("ground_truth", "none"):
            raise ValueError(f"cost dynamics: got mode {mode}, expected one that infers latents: use plan.cost=slots")
        self.inverse_dynamics, self.whitening = inverse_dynamics, whitening
        self.goal = inverse_dynamics.scene_dynamics(goal)[0]

    def __call__(self, slots: Tensor) -> Tensor:
        here = self.inverse_dynamics.scene_dynamics(slots)[0]
        squares = self.whitening.turn(here - self.goal).square()
        return squares.flatten(slots.ndim - 2).mean(-1)


class ImageDistance:
    """Mean squared difference of decoded frames to the goal image (3, H, W): dearer, and blind to what is hidden."""

    def __init__(self, savi: SAVi, goal: Tensor) -> None:
        self.savi, self.goal = savi, normalise(goal)

    def __call__(self, slots: Tensor) -> Tensor:
        frames: Tensor = self.savi.decode(slots).frames
        return (frames - self.goal).square().mean((-3, -2, -1))


def goal_distance(agent: Agent, kind: CostName, goal: Tensor, image: Tensor, match: bool | None = None) -> Distance:
    """The distance to a goal by its name, from its slots (N, D) and, for `image`, its picture (3, H, W), uint8 [0, 255]
    or float [0, 1]. `match` None: the order of the slots is free where SAVi's initial slots are sampled.
    """
    model = agent.world_model
    if kind == "image":
        return ImageDistance(model.savi, image)
    if kind == "dynamics":
        whitening = agent.policy.whitening or latent_statistics(agent)
        return DynamicsDistance(model.inverse_dynamics, whitening, goal)
    return SlotDistance(goal, model.config.savi.initial == "gaussian" if match is None else match)


class GoalCost:
    """Cost of latent actions from where an episode stands: slots (S, N, D) of the frames seen so far, the present one
    last, at most the predictor's context, and the latent actions (S - 1, [N,] Z) between them. `along` is a, 0 to 1;
    `rows` candidates are imagined at once, for the memory.
    """

    def __init__(
        self,
        world_model: WorldModel,
        slots: Tensor,
        past: Tensor,
        distance: Distance,
        along: float = 0.5,
        rows: int = 512,
    ) -> None:
        self.world_model, self.slots, self.past = world_model, slots, past
        self.distance, self.along, self.rows = distance, along, rows

    def imagine(self, latents: Tensor) -> Tensor:
        """Slots (M, H, N, D) that follow the present frame under latent actions (M, H, [N,] Z)."""
        m = len(latents)
        z = torch.cat([self.past.expand(m, *self.past.shape), latents], 1)
        return self.world_model.futures(self.slots.expand(m, *self.slots.shape), z)[:, len(self.past) :]

    def __call__(self, latents: Tensor) -> Tensor:
        """Latent actions (M, H, [N,] Z) to costs (M,)."""
        return torch.cat([self._cost(some) for some in latents.split(self.rows)])

    def _cost(self, latents: Tensor) -> Tensor:
        future = self.imagine(latents)
        last = self.distance(future[:, -1])
        if self.along == 0:
            return last
        return (1 - self.along) * last + self.along * self.distance(future).mean(1)


class NearProposal:
    """A cost J, and what straying from a proposed plan z^ (H, [N,] Z) costs beside it, in whitened latent actions.

        J'(z) = J(z) + w / HZ sum_t |W^-1 (z_t - z^_t)|^2

    As in model-based offline planning (Argenson and Dulac-Arnold, ICLR 2021) the search stays where the demonstrations
    were: latents far from the policy's lead to futures that model and decoder guess, and a search finds the guesses
    that please it. The proposal itself costs what it did.

    Examples:
        >>> near = NearProposal(lambda z: torch.zeros(len(z)), torch.zeros(2, 1), Whitening(1), 3.0)
        >>> near(torch.tensor([[[0.0], [0.0]], [[2.0], [0.0]]])).tolist()
        [0.0, 6.0]
    """

    def __init__(self, cost: Cost, proposal: Tensor, whitening: Whitening, weight: float) -> None:
        self.cost, self.proposal, self.whitening, self.weight = cost, proposal, whitening, weight

    def __call__(self, latents: Tensor) -> Tensor:
        """Latent actions (M, H, [N,] Z) to costs (M,)."""
        strayed = self.whitening.turn(latents - self.proposal).square()
        return self.cost(latents) + self.weight * strayed.flatten(1).mean(1)
