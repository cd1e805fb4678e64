"""Acting by planning, on an untrained world model: what is planned, when, and from what."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from tensordict import TensorDictBase
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.agent import imagine
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.acting.planners import build_planner, search_size, shifted
from playslot_rl.acting.planning import PlanningActor
from playslot_rl.config import PlanConfig
from playslot_rl.config.planning import PLANNERS
from playslot_rl.errors import ConfigError
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent

PLAN = PlanConfig(horizon=4, every=2, candidates=8, iterations=2, elites=3, descents=2)
SIZE = search_size(PLAN, "solved", 5)
ROUNDING = 1e-5
"""A plan that is the proposal itself costs the same but for the size of the batch that it was computed in."""


@pytest.fixture(scope="module")
def agent() -> Agent:
    return tiny_agent().requires_grad_(False)


def goals(seeds: Sequence[int]) -> Tensor:
    return torch.stack([frames(1, seed=seed)[0] for seed in seeds])


def frames(n: int, seed: int = 0) -> Tensor:
    return torch.randint(256, (n, 3, 64, 64), generator=torch.Generator().manual_seed(seed)).byte()


def actor(
    agent: Agent, name: str = "cem", policy: bool = False, plan: PlanConfig = PLAN, seed: int = 0
) -> PlanningActor:
    planner = build_planner(name, plan, SIZE, agent.world_model)  # type: ignore[arg-type]
    return PlanningActor(agent, planner, plan, SIZE, goals, policy, seed).eval()


def acted(of: PlanningActor, seeds: Sequence[int], steps: int) -> list[TensorDictBase]:
    """What the actor writes at the same frames, given one after the other."""
    loop, device = ClosedLoop(of), "cpu"
    loop.reset(seeds)
    seen = []
    for step in range(steps):
        rows = torch.stack([frames(1, 1000 * seed + step)[0] for seed in seeds])
        seen.append(loop.step(of.reset(seeds).empty().set(keys.PIXELS, rows.to(device))))
    return seen


@pytest.mark.integration
@pytest.mark.parametrize("name", PLANNERS)
@pytest.mark.parametrize("policy", [False, True])
def test_every_planner_acts_and_its_first_plan_is_no_worse_than_the_proposal(
    agent: Agent, name: str, policy: bool
) -> None:
    seen = acted(actor(agent, name, policy), [7, 8], 3)
    for moment in seen:
        assert moment[keys.ACTION].shape == (2, 4)
        assert bool((moment[keys.ACTION].abs() <= 1).all())
        assert moment[keys.PREDICTED_SLOTS].shape == (2, 5, 4, 32)
        if policy:
            assert bool((moment[keys.PLAN_COST] <= moment[keys.PROPOSAL_COST] * (1 + ROUNDING)).all())
        else:
            assert bool(moment[keys.PROPOSAL_COST].isnan().all())


@pytest.mark.integration
@pytest.mark.parametrize("name", PLANNERS)
def test_the_more_a_plan_has_to_stay_near_the_policys_the_nearer_it_is(agent: Agent, name: str) -> None:
    def strayed(prior: float) -> float:
        plan = replace(PLAN, prior=prior)
        of = PlanningActor(agent, actor(agent, name).planner, plan, search_size(plan, "solved", 5), goals, True).eval()
        (seen,) = acted(of, [7], 1)
        proposal = imagine(agent, seen.select(keys.SLOTS), SIZE.horizon).latents
        return float((of.whitening(seen[keys.PLANNED_LATENTS]) - of.whitening(proposal)).square().mean())

    assert strayed(0) > 1e-3
    assert strayed(1e9) < 1e-9


def test_a_policy_means_the_goals_that_it_was_cloned_for() -> None:
    assert search_size(PLAN, "solved", 5).prior > 0
    assert search_size(PLAN, "ahead", 5).prior == 0
    assert [search_size(replace(PLAN, prior=0.0), goals, 5).prior for goals in ("solved", "ahead")] == [0, 0]


def test_it_plans_every_second_step_and_executes_the_plan_between(agent: Agent) -> None:
    seen = acted(actor(agent), [7], 4)
    first, second, third, _ = (moment[keys.PLANNED_LATENTS] for moment in seen)
    assert torch.equal(first, second)
    assert not torch.equal(second, third)
    assert torch.equal(seen[0][keys.LATENT_ACTION], first[:, 0])
    assert torch.equal(seen[1][keys.LATENT_ACTION], first[:, 1])
    assert torch.equal(seen[2][keys.LATENT_ACTION], third[:, 0])


def test_a_plan_begins_where_the_last_one_ends(agent: Agent) -> None:
    starts: list[Tensor] = []
    of = actor(agent, policy=True)
    planner = of.planner

    def watched(search: object, generator: torch.Generator) -> object:
        starts.append(search.starts)  # type: ignore[attr-defined]
        return planner(search, generator)  # type: ignore[arg-type]

    of.planner = watched  # type: ignore[assignment]
    seen = acted(of, [7], 3)
    assert [len(start) for start in starts] == [1, 2]
    expected = shifted(seen[0][keys.PLANNED_LATENTS][0], 2, of.whitening.mean)
    assert torch.equal(starts[1][1], expected)
    proposal = imagine(agent, seen[2].select(keys.SLOTS), SIZE.horizon).latents
    torch.testing.assert_close(starts[1][:1], proposal)


@pytest.mark.integration
@pytest.mark.parametrize("name", ["cem", "prototypes"])
def test_episodes_side_by_side_do_not_touch_each_other_and_repeat(agent: Agent, name: str) -> None:
    both, again = acted(actor(agent, name), [7, 8], 3), acted(actor(agent, name), [7, 8], 3)
    alone = acted(actor(agent, name), [8], 3)
    for one, same, single in zip(both, again, alone, strict=True):
        assert torch.equal(one[keys.ACTION], same[keys.ACTION])
        torch.testing.assert_close(one[keys.PLANNED_LATENTS][1:], single[keys.PLANNED_LATENTS], atol=1e-5, rtol=1e-4)
    if name == "cem":
        other = acted(actor(agent, name, seed=1), [8], 1)
        assert not torch.equal(other[0][keys.PLANNED_LATENTS], alone[0][keys.PLANNED_LATENTS])


def test_history_reaches_the_cost_as_far_as_it_goes(agent: Agent) -> None:
    of = actor(agent, plan=PlanConfig(horizon=4, every=2, candidates=8, iterations=1, elites=3, history=3))
    seen = acted(of, [7], 4)
    lengths = [len(of._cost(moment, 0, step).slots) for step, moment in enumerate(seen)]
    assert lengths == [1, 2, 3, 3]
    assert torch.equal(of._cost(seen[3], 0, 3).slots[-1], seen[3][keys.SLOTS][0])
    assert len(of._cost(seen[3], 0, 3).past) == 2


@pytest.mark.parametrize("cost", ["slots", "dynamics", "image"])
def test_every_cost_plans(agent: Agent, cost: str) -> None:
    plan = PlanConfig(horizon=4, every=2, candidates=4, iterations=1, elites=2, cost=cost)  # type: ignore[arg-type]
    assert float(acted(actor(agent, plan=plan), [7], 1)[0][keys.PLAN_COST]) > 0


def test_prototypes_are_refused_where_there_are_none() -> None:
    model = tiny_agent(tiny_config("continuous")).world_model
    with pytest.raises(ConfigError, match="planner=prototypes: got a world model of mode continuous"):
        build_planner("prototypes", PLAN, SIZE, model)


def test_the_goals_decide_what_is_left_open() -> None:
    ours, theirs = search_size(PlanConfig(), "solved", 5), search_size(PlanConfig(), "ahead", 5)
    assert (theirs.horizon, theirs.every, theirs.candidates, theirs.iterations, theirs.elites) == (5, 5, 300, 30, 30)
    assert search_size(PlanConfig(), "ahead", 2).horizon == 12
    assert ours != theirs
    assert search_size(PlanConfig(horizon=3), "ahead", 5).every == 3
    with pytest.raises(ValueError, match=r"plan\.every: got 9, expected at most"):
        search_size(PlanConfig(every=9), "ahead", 5)
    with pytest.raises(ValueError, match=r"plan\.elites: got 100, expected at most"):
        search_size(PlanConfig(elites=100), "solved", 5)
