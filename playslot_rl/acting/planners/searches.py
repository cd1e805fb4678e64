"""The planners that search: each refines a mean, a distribution or starts, from the plans it is given to begin with.

Deviations (`spread`; `start_spread` where there are plans to begin with; `floor`, the least) are in whitened
coordinates, as of the training latents; `correlation`, 0 to under 1, is that of the noise of neighbouring steps, which
resemble each other in a motion. `iterations` do not count where the search is given seconds.

Nothing reads a value before the plan, so on a GPU the host runs ahead. There the rollout is replayed as one launch: of
1,857 a step of cross-entropy at `compact`, 83 are left. They are not captured, since every plan has another cost.

Shapes: M candidates, K elites or prototypes, H horizon, Z latent-action width.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from playslot_rl.acting.planners.planner import Best, Plan, Search
from playslot_rl.modules.quantizer import one_hot


@dataclass(frozen=True)
class CEMPlanner:
    """The cross-entropy method with a Gaussian: draw M candidates, keep the K elites, draw from what they have in
    common.

        c ~ N(mu, sigma^2),   mu, sigma <- mean and deviation of the K elites,   sigma >= floor

    As in iCEM (Pinneri et al., 2020) the elites stay candidates of the next iteration, so the best cost never rises.

    Examples:
        >>> from playslot_rl.modules.whitening import Whitening
        >>> goal = torch.tensor([[1.0, -1.0], [0.5, 0.0]])
        >>> search = Search(lambda z: (z - goal).square().sum((1, 2)), (2, 2), Whitening(2), torch.empty(0, 2, 2))
        >>> CEMPlanner()(search, torch.Generator().manual_seed(0)).cost < 1e-2
        True
    """

    candidates: int = 64
    iterations: int = 10
    elites: int = 8
    spread: float = 1.0
    start_spread: float = 0.2
    floor: float = 0.05
    correlation: float = 0.5

    @torch.no_grad()
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        best = Best(search)
        mean = search.coordinates(best.begin())
        std = torch.full_like(mean, search.first_spread(self.spread, self.start_spread))
        kept = mean.new_empty(0, *search.shape)
        for _ in search.rounds(self.iterations):
            mean, std, kept = self._improve(search, best, mean, std, kept, generator)
            best.note()
        return best.plan()

    def _improve(
        self, search: Search, best: Best, mean: Tensor, std: Tensor, kept: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One iteration: mean and deviation (H, [N,] Z) and elites (K, H, [N,] Z), in whitened coordinates."""
        drawn = search.around(mean, std, self.candidates, self.correlation, generator)
        tried = torch.cat([drawn, mean[None], kept])  # at first the mean is the best plan to begin with
        latents = search.latents(tried)
        costs = best.offer(latents, search.cost(latents))
        elites = tried[costs.topk(min(self.elites, len(tried)), largest=False).indices]
        return elites.mean(0), elites.std(0, unbiased=False).clamp(min=self.floor), elites


@dataclass(frozen=True)
class MPPIPlanner:
    """Model-predictive path integral control: the next mean is the average of all candidates, weighted by their cost.

        w_i = softmax(-(J_i - min J) / (temperature * scale)),   mu <- sum_i w_i c_i

    The exponent is in the standard deviation of the candidates' costs, so it neither underflows nor depends on their
    unit; a small temperature follows the best alone. The noise's deviation falls by `decay` from iteration to
    iteration.
    """

    candidates: int = 64
    iterations: int = 10
    temperature: float = 0.2
    spread: float = 1.0
    start_spread: float = 0.2
    floor: float = 0.05
    decay: float = 0.8
    correlation: float = 0.5

    @torch.no_grad()
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        best = Best(search)
        mean = search.coordinates(best.begin())
        std = search.first_spread(self.spread, self.start_spread)
        for _ in search.rounds(self.iterations):
            drawn = search.around(mean, std, self.candidates, self.correlation, generator)
            tried = torch.cat([drawn, mean[None], search.coordinates(best.latents)[None]])
            latents = search.latents(tried)
            weights = path_weights(best.offer(latents, search.cost(latents)), self.temperature)
            mean = torch.tensordot(weights, tried, 1)
            std = max(self.decay * std, self.floor)
            best.note()
        last = search.latents(mean)[None]
        best.offer(last, search.cost(last))
        return best.plan()


def path_weights(costs: Tensor, temperature: float) -> Tensor:
    """Weights (M,) that sum to one, largest for the least cost; costs (M,) may be infinite, but not all of them.

    Examples:
        >>> path_weights(torch.tensor([1e30, 2e30, float("inf")]), 0.2).sum().item()
        1.0
    """
    costs = costs.double()  # squares of 1e30 overflow in single precision
    finite = costs.isfinite()
    share = finite.double().mean()
    # Infinite ones become the others' mean: nothing is chosen by a mask, of which the device would be asked.
    known = torch.where(finite, costs, torch.where(finite, costs, 0.0).mean() / share)
    scale = known.std(unbiased=False) / share.sqrt()
    scale = scale.clamp(min=1e-12 * known.abs().max().clamp(min=1e-12))
    weights = torch.softmax(-(costs - known.min()) / (temperature * scale), 0)
    return torch.where(share > 0, weights, 1 / len(costs)).float()


@dataclass(frozen=True)
class GradientPlanner:
    """Adam in whitened coordinates, through the differentiable rollout, from M starts side by side; the learning rate
    is in the training latents' deviation. The first start is the best plan to begin with, or else the mean latent
    action held; the others lie round it. Iterates are judged by the cost that they have, not by the last step.
    """

    candidates: int = 4
    iterations: int = 30
    learning_rate: float = 0.1
    spread: float = 1.0
    start_spread: float = 0.2
    correlation: float = 0.5

    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
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
                costs.backward(torch.where(finite, 1 / costs.detach().abs().clamp(min=1e-30), 0.0))
                optimiser.step()
                with torch.no_grad():
                    point.clamp_(-search.bound, search.bound)
        last = search.latents(point.detach())
        with torch.no_grad():
            best.offer(last, search.cost(last))
        return best.plan()


@dataclass(frozen=True)
class PrototypePlanner:
    """The cross-entropy method over prototypes (K, Z): every step has a categorical distribution over the K codes.

        k_t ~ Cat(pi_t),   pi_t <- (1 - s) * (the elites' frequencies at t) + s / K

    A plan is a sequence of prototypes, variability zero: K^H of them, the moves a player has with the number keys.
    Plans to begin with are candidates as they are, and the part `lean` of the first distribution is on the prototypes
    nearest to the best of them; s is `floor`.

    Examples:
        >>> from playslot_rl.modules.whitening import Whitening
        >>> search = Search(lambda z: (z - 2.0).square().sum((1, 2)), (3, 1), Whitening(1), torch.empty(0, 3, 1))
        >>> planner = PrototypePlanner(torch.tensor([[0.0], [1.0], [2.0]]))
        >>> planner(search, torch.Generator().manual_seed(0)).latents.flatten().tolist()
        [2.0, 2.0, 2.0]
    """

    prototypes: Tensor
    candidates: int = 64
    iterations: int = 10
    elites: int = 8
    floor: float = 0.05
    lean: float = 0.5

    @torch.no_grad()
    def __call__(self, search: Search, generator: torch.Generator) -> Plan:
        best, k = Best(search), len(self.prototypes)
        first = best.begin()
        steps = search.shape[:-1]
        probabilities = torch.full((*steps, k), 1 / k, device=self.prototypes.device)
        if len(search.starts):
            near = torch.cdist(first.reshape(-1, first.shape[-1]), self.prototypes).argmin(-1).reshape(steps)
            probabilities = (1 - self.lean) * probabilities + self.lean * one_hot(near, k)
        kept = torch.empty(0, *steps, dtype=torch.long, device=self.prototypes.device)
        for _ in search.rounds(self.iterations):
            drawn = torch.multinomial(
                probabilities.reshape(-1, k), self.candidates, replacement=True, generator=generator
            )
            tried = torch.cat([drawn.T.reshape(-1, *steps), kept])
            latents = self.prototypes[tried]
            costs = best.offer(latents, search.cost(latents))
            kept = tried[costs.topk(min(self.elites, len(tried)), largest=False).indices]
            probabilities = (1 - self.floor) * one_hot(kept, k).float().mean(0) + self.floor / k
            best.note()
        return best.plan()
