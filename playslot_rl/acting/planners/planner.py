"""What a planner is: a search for the latent actions whose imagined future costs least.

    z*_{1:H} = argmin_z  cost(rollout(S, z_{1:H}))

It sees a `Search` alone, so it serves the world model, a toy cost in a test, and any other model. All planners but the
categorical one search in whitened coordinates c of the latents (`playslot_rl.modules.whitening`), where the training
latents have unit scale: a standard deviation of 1 in the latents themselves, where theirs is a tenth, draws futures
that the model has never seen.

Shapes: M candidates, H horizon, Z latent-action width. "[N,]" is there with one latent action per slot.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from playslot_rl.modules.whitening import FADE, Whitening
from playslot_rl.world_model import Agent

Cost = Callable[[Tensor], Tensor]
"""Latent actions (M, H, [N,] Z) to what each plan costs (M,), lower is better."""


@dataclass(frozen=True)
class Search:
    """A problem to be planned in.

    Attributes:
        cost: of candidates; differentiable for the gradient planner.
        shape: (H, [N,] Z) of a plan.
        starts: plans (S, H, [N,] Z) to begin with, such as the shifted last plan or a policy's; S may be 0.
        bound: the search stays where every whitened coordinate is in [-bound, bound]; beyond, the model is guessing.
        seconds: of wall clock that the search may take, at least one iteration, after each of which it then waits for
            the device; 0: the planner's iterations decide, and the plan is a function of its inputs.
    """

    cost: Cost
    shape: tuple[int, ...]
    whitening: Whitening
    starts: Tensor
    bound: float = 3.0
    seconds: float = 0.0

    def rounds(self, iterations: int) -> Iterator[int]:
        """Number the iterations: so many, or as many as begin within the time."""
        begin, done = time.perf_counter(), 0
        while done == 0 or (time.perf_counter() - begin < self.seconds if self.seconds else done < iterations):
            yield done
            done += 1
            if self.seconds and self.starts.is_cuda:
                torch.cuda.synchronize(self.starts.device)

    def latents(self, coordinates: Tensor) -> Tensor:
        """Whitened coordinates (..., Z) to latent actions."""
        return self.whitening.inverse(coordinates)

    def coordinates(self, latents: Tensor) -> Tensor:
        """Latent actions (..., Z) to whitened coordinates, inside the bound."""
        coordinates: Tensor = self.whitening(latents).clamp(-self.bound, self.bound)
        return coordinates

    def first_spread(self, spread: float, start_spread: float) -> float:
        return start_spread if len(self.starts) else spread

    def around(
        self, mean: Tensor, std: Tensor | float, count: int, correlation: float, generator: torch.Generator
    ) -> Tensor:
        """Coordinates (count, H, [N,] Z) drawn round a plan's (H, [N,] Z), inside the bound, with correlated noise."""
        white = torch.randn(count, *self.shape, generator=generator, device=generator.device)
        return (mean + std * correlated(white, correlation)).clamp(-self.bound, self.bound)


class Plan(NamedTuple):
    """The best latents (H, [N,] Z) of all whose cost was computed, their cost, and the best known
    after each iteration.
    """

    latents: Tensor
    cost: float
    costs: list[float]


class Planner(Protocol):
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        """Search; the generator draws all candidates, on its device. A ValueError where no cost is finite."""


class Best:
    """The best plan so far and its cost, on the device: nothing waits for them before `plan` reads them. Plans to begin
    with are tried first, so that nothing worse than they are is returned.
    """

    def __init__(self, search: Search) -> None:
        mean = search.whitening.mean
        self.search, self._noted = search, list[Tensor]()
        self.latents, self.cost = mean.expand(search.shape), mean.new_full((), torch.inf)

    @torch.no_grad()
    def begin(self) -> Tensor:
        """Try the mean latent action held and the given plans; returns the better one's latents (H, [N,] Z)."""
        tried = torch.cat([self.latents[None], self.search.starts])
        self.offer(tried, self.search.cost(tried))
        return self.latents

    def offer(self, latents: Tensor, costs: Tensor) -> Tensor:
        """Take the best of some candidates if it is better; returns their costs (M,), infinite where not finite."""
        costs = torch.where(costs.isfinite(), costs, torch.inf).detach()
        index = costs.argmin(0, keepdim=True)  # a number would be read
        better = costs[index][0] < self.cost
        self.latents = torch.where(better, latents[index][0].detach(), self.latents)
        self.cost = torch.where(better, costs[index][0], self.cost)
        return costs

    def note(self) -> None:
        self._noted.append(self.cost)

    def plan(self) -> Plan:
        """The result; a ValueError where no candidate had a finite cost."""
        *costs, cost = torch.stack([*self._noted, self.cost]).tolist()
        if cost == float("inf"):
            raise ValueError("plan: got no finite cost, expected one: look at the goal and at the model's predictions")
        return Plan(self.latents, cost, costs)


def correlated(noise: Tensor, correlation: float) -> Tensor:
    """White noise (M, H, ...) to noise of the same variance whose neighbouring steps correlate (an AR(1) process)."""
    steps = [noise[:, 0]]
    for t in range(1, noise.shape[1]):
        steps.append(correlation * steps[-1] + (1 - correlation**2) ** 0.5 * noise[:, t])
    return torch.stack(steps, 1)


def shifted(plan: Tensor, steps: int, fill: Tensor) -> Tensor:
    """A plan (H, [N,] Z) after `steps` of it were executed: the rest, then `fill` ([N,] Z) to the horizon.

    Examples:
        >>> shifted(torch.tensor([[1.0], [2.0], [3.0]]), 2, torch.zeros(1)).flatten().tolist()
        [3.0, 0.0, 0.0]
    """
    rest = plan[steps:]
    return torch.cat([rest, fill.expand(len(plan) - len(rest), *plan.shape[1:])])


@torch.no_grad()
def unfaded(whitening: Whitening) -> Whitening:
    """The same mean and directions with the data's own deviations, at least a thousandth of the first one's."""
    plain = copy.deepcopy(whitening)
    squares = whitening.scale.double().square()
    first = squares[0] / (1 + FADE)
    plain.scale.copy_((squares - FADE * first).clamp(min=1e-6 * first).sqrt())
    return plain


def latent_statistics(agent: Agent) -> Whitening:
    """Mean, directions and deviations of the latent actions that an agent was trained on: by its policy's whitening
    (the demonstrations' inferred latents), else its action decoder's whitening, else that one's mean and scale.

    Note: networks take coordinates in which directions of next to no variance fade out. A search must draw in these
    what the data have there, or most of a plan is noise that the model has never seen; so the fading is taken back.
    """
    found = agent.policy.whitening or agent.action_decoder.whitening
    if found is not None:
        return unfaded(found)
    decoder = agent.action_decoder
    plain = Whitening(decoder.mean.shape[-1]).to(decoder.mean.device)
    plain.mean.copy_(decoder.mean)
    plain.scale.copy_(decoder.scale)
    return plain
