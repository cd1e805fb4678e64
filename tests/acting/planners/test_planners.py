"""Planners on costs whose optimum is known."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from typing import get_args
from unittest.mock import Mock

import pytest
import torch
from tiny_searches import tiny_search
from torch import Tensor
from waits import no_waits

from playslot_rl.acting.planners import (
    CEMPlanner,
    GradientPlanner,
    MPPIPlanner,
    Planner,
    PrototypePlanner,
    Search,
    shifted,
)
from playslot_rl.acting.planners.planner import Best, correlated, latent_statistics, unfaded
from playslot_rl.acting.planners.searches import path_weights
from playslot_rl.config import ActionDecoderConfig, PolicyConfig
from playslot_rl.config.planning import PlannerName
from playslot_rl.modules.whitening import Whitening
from playslot_rl.testing import tiny_agent, tiny_config

H, Z = 4, 3
GOAL = torch.tensor([[0.5, -1.0, 0.2], [1.0, 0.0, -0.3], [-0.4, 0.3, 0.0], [0.0, 0.8, 1.0]])
PROTOTYPES = torch.randn(4, Z, generator=torch.Generator().manual_seed(1))
PLANNERS: dict[str, Planner] = {
    "cem": CEMPlanner(),
    "mppi": MPPIPlanner(),
    "gradient": GradientPlanner(),
    "prototypes": PrototypePlanner(PROTOTYPES),
}


def bowl(z: Tensor) -> Tensor:
    return (z - GOAL).square().sum((1, 2))


def watched(seen: list[Tensor]) -> Callable[[Tensor], Tensor]:
    """The bowl, which keeps what it is asked."""

    def cost(z: Tensor) -> Tensor:
        seen.append(z)
        return bowl(z)

    return cost


def search(cost: Callable[[Tensor], Tensor] = bowl, starts: Tensor | None = None, scale: float = 1.0) -> Search:
    whitening = Whitening(Z)
    whitening.scale.fill_(scale)
    return Search(cost, (H, Z), whitening, torch.empty(0, H, Z) if starts is None else starts)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("name", ["cem", "mppi", "gradient"])
def test_a_known_optimum_is_found(name: str) -> None:
    longer = {"cem": replace(CEMPlanner(), iterations=30), "mppi": MPPIPlanner(iterations=30)}
    plan = longer.get(name, GradientPlanner(iterations=100))(search(), generator())
    assert plan.cost < 0.02, "standing still costs 4.8"
    torch.testing.assert_close(plan.latents, GOAL, atol=0.15, rtol=0)
    assert plan.cost == pytest.approx(float(bowl(plan.latents[None])[0]), rel=1e-5)


@pytest.mark.parametrize("name", list(PLANNERS))
def test_the_best_cost_never_rises(name: str) -> None:
    plan = PLANNERS[name](search(), generator())
    assert all(after <= before for before, after in itertools.pairwise(plan.costs))
    assert plan.cost <= plan.costs[-1] < float(bowl(torch.zeros(1, H, Z))[0])


@pytest.mark.parametrize("name", list(PLANNERS))
def test_the_same_generator_gives_the_same_plan_and_the_global_one_is_left_alone(name: str) -> None:
    before = torch.random.get_rng_state()
    one, same, other = (PLANNERS[name](search(), generator(seed)) for seed in (3, 3, 4))
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.equal(one.latents, same.latents)
    if name in ("cem", "mppi"):  # the others find the same best sequence, or descend from the same start
        assert not torch.equal(one.latents, other.latents)


@pytest.mark.parametrize("name", list(PLANNERS))
def test_a_plan_to_begin_with_is_never_made_worse(name: str) -> None:
    rough = lambda z: (z - GOAL).abs().sum((1, 2)) + (7 * z).sin().sum((1, 2))  # noqa: E731
    for seed in range(5):
        start = GOAL + 0.1 * torch.randn(1, H, Z, generator=generator(seed))
        plan = PLANNERS[name](search(rough, start), generator(seed))
        assert plan.cost <= float(rough(start)[0])


def test_elites_stay_candidates() -> None:
    seen: list[Tensor] = []
    CEMPlanner(candidates=20, elites=5, iterations=4)(search(watched(seen)), generator())
    for before, after in itertools.pairwise(seen[1:]):  # the first are the plans to begin with
        elites = before[bowl(before).topk(5, largest=False).indices]
        assert all((after - elite).abs().amax((1, 2)).min() < 1e-6 for elite in elites)


@pytest.mark.parametrize("floor", [0.05, 0.5])
def test_the_deviation_never_falls_under_its_floor(floor: float) -> None:
    planner = CEMPlanner(candidates=400, iterations=25, floor=floor, correlation=0.0)
    seen: list[Tensor] = []
    planner(search(watched(seen)), generator())
    spread = seen[-1][:400].std(0)  # those that were drawn in the last iteration
    assert 0.85 * floor < float(spread.mean()) < 1.5 * floor


def test_one_elite_is_enough() -> None:
    plan = CEMPlanner(elites=1)(search(), generator())
    assert plan.latents.isfinite().all()


def test_candidates_are_drawn_at_the_scale_of_the_latents() -> None:
    seen: list[Tensor] = []
    CEMPlanner(candidates=500, iterations=1)(search(watched(seen), scale=0.01), generator())
    assert float(seen[1].std()) == pytest.approx(0.01, rel=0.1)
    assert float(seen[1].abs().max()) <= 0.03 + 1e-6, "the bound is three deviations"


def test_correlated_noise_keeps_its_variance() -> None:
    noise = correlated(torch.randn(4000, 6, 2, generator=generator()), 0.7)
    assert float(noise.std()) == pytest.approx(1.0, abs=0.03)
    assert float((noise[:, 1:] * noise[:, :-1]).mean()) == pytest.approx(0.7, abs=0.05)


def test_a_plan_is_shifted_by_what_was_executed() -> None:
    plan, fill = torch.arange(12.0).reshape(4, 3), torch.full((3,), -1.0)
    assert torch.equal(shifted(plan, 0, fill), plan)
    assert torch.equal(shifted(plan, 1, fill), torch.cat([plan[1:], fill[None]]))
    assert torch.equal(shifted(plan, 4, fill), fill.expand(4, 3))


def test_categorical_search_finds_the_best_sequence_of_all() -> None:
    steps, everything = 6, torch.tensor(list(itertools.product(range(4), repeat=6)))
    for seed in range(3):
        table = torch.rand(steps, 4, generator=generator(seed))
        bonus = 0.2 * torch.rand(4, 4, generator=generator(seed + 50))  # of neighbours: steps are not independent

        def cost(z: Tensor, table: Tensor = table, bonus: Tensor = bonus) -> Tensor:
            k = torch.cdist(z, PROTOTYPES).argmin(-1)
            held = (z == 0).all(-1).any(-1)  # the mean latent action, which is no prototype
            return table[torch.arange(steps), k].sum(1) - bonus[k[:, 1:], k[:, :-1]].sum(1) + 10.0 * held

        problem = replace(search(cost), shape=(steps, Z), starts=torch.empty(0, steps, Z))
        plan = PrototypePlanner(PROTOTYPES, candidates=100, iterations=10)(problem, generator(seed))
        assert plan.cost == pytest.approx(float(cost(PROTOTYPES[everything]).min())), f"{len(everything)} sequences"


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
def test_mppi_weights_are_finite_whatever_the_costs(size: float) -> None:
    costs = size * torch.tensor([3.0, 1.0, 2.0, float("inf")])
    weights = path_weights(costs, 0.01)
    assert weights.isfinite().all()
    assert float(weights.sum()) == pytest.approx(1.0)
    assert weights.argmax() == 1
    assert path_weights(torch.full((3,), size), 0.01).tolist() == pytest.approx([1 / 3] * 3)


@pytest.mark.parametrize("name", list(PLANNERS))
def test_huge_and_infinite_costs_give_a_plan(name: str) -> None:
    def cost(z: Tensor) -> Tensor:
        return torch.where(z[:, 0, 0] > 0.3, torch.nan, 1e30 * (1 + bowl(z)))

    plan = PLANNERS[name](search(cost), generator())
    assert plan.latents.isfinite().all()
    assert plan.cost <= 1e30 * (1 + float(bowl(torch.zeros(1, H, Z))[0]))


@pytest.mark.parametrize("name", list(PLANNERS))
def test_no_finite_cost_at_all_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match="no finite cost, expected one"):
        PLANNERS[name](search(lambda z: torch.nan * z.sum((1, 2))), generator())


def test_the_gradient_lowers_the_cost_without_gradients_around_it() -> None:
    with torch.no_grad():
        plan = GradientPlanner(candidates=1, iterations=20)(search(), generator())
    assert plan.costs[-1] < 0.5 * plan.costs[0]


def test_seconds_decide_in_place_of_iterations() -> None:
    one = CEMPlanner(iterations=50)(replace(search(), seconds=1e-9), generator())
    assert len(one.costs) == 1
    many = CEMPlanner(iterations=1)(replace(search(), seconds=0.2), generator())
    assert len(many.costs) > 1


@torch.no_grad()
def test_statistics_are_those_of_the_training_latents() -> None:
    z = torch.randn(4000, 8, generator=generator()) * torch.logspace(0, -3, 8) + 0.3
    for whiten in (True, False):
        config = tiny_config()
        model = replace(
            config.model, policy=PolicyConfig(whiten=whiten), action_decoder=ActionDecoderConfig(whiten=False)
        )
        agent = tiny_agent(replace(config, model=model))
        if agent.policy.whitening is not None:
            agent.policy.whitening.fit(z)
        agent.action_decoder.standardise(z)
        c = latent_statistics(agent)(z)
        assert c.mean(0).abs().max() < 1e-2
        torch.testing.assert_close(c.std(0), torch.ones(8), atol=0.1, rtol=0)


@torch.no_grad()
def test_faded_directions_are_taken_back() -> None:
    z = torch.randn(5000, 3, generator=generator()) * torch.tensor([1.0, 0.1, 0.01])
    whitening = Whitening(3)
    whitening.fit(z)
    assert float(whitening(z).std(0)[2]) < 0.2, "faded out"
    torch.testing.assert_close(unfaded(whitening)(z).std(0), torch.ones(3), atol=0.02, rtol=0)
    assert torch.equal(unfaded(whitening).basis, whitening.basis)


@pytest.mark.parametrize("name", get_args(PlannerName))
def test_a_search_reads_no_value_before_its_plan(name: PlannerName, monkeypatch: pytest.MonkeyPatch) -> None:
    """So on a GPU the host is always ahead of the device."""
    planner, problem = tiny_search(name)
    expected, read = planner(problem, generator()), Best.plan
    monkeypatch.setattr(Best, "plan", lambda best: best)
    monkeypatch.setattr(torch.optim.Adam, "step", adam := Mock())  # it counts its steps on the host
    with no_waits():
        best = planner(problem, generator())
    plan = read(best)  # type: ignore[arg-type]
    assert len(plan.costs) == len(expected.costs) > 2
    if not adam.called:
        assert torch.equal(plan.latents, expected.latents)
