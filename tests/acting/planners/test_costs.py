"""What a plan costs, and that TorchRL's planners see the same futures at the same cost."""

from __future__ import annotations

import itertools

import pytest
import torch
from tiny_savi import tiny_savi
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import goal_slots
from playslot_rl.acting.planners import CEMPlanner, GradientPlanner, Search, latent_statistics
from playslot_rl.acting.planners.costs import (
    DynamicsDistance,
    GoalCost,
    ImageDistance,
    NearProposal,
    SlotDistance,
    assignment,
)
from playslot_rl.acting.planners.torchrl_planning import ReturnAdvantage, latent_of, planning_env, planning_start
from playslot_rl.api import PlaySlot
from playslot_rl.modules.whitening import Whitening
from playslot_rl.seeds.draws import global_seed
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent, WorldModel


@pytest.fixture(scope="module")
def agent() -> Agent:
    return tiny_agent().requires_grad_(False)


def drawn(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def whitening() -> Whitening:
    found = Whitening(8)
    found.fit(drawn(200, 8, seed=5) * torch.linspace(0.05, 0.3, 8) + 0.1)
    return found


def test_slots_are_matched_as_the_best_permutation_does() -> None:
    slots, goal = drawn(7, 3, 4, 5), drawn(4, 5, seed=1)
    every = torch.tensor(list(itertools.permutations(range(4))))
    expected = (slots[..., None, :, :] - goal[every]).square().mean((-2, -1)).amin(-1)
    torch.testing.assert_close(SlotDistance(goal, match=True)(slots), expected)
    assert bool((SlotDistance(goal)(slots) >= SlotDistance(goal, match=True)(slots)).all())


def test_what_is_not_finite_is_matched_all_the_same() -> None:
    assert assignment(torch.full((1, 3, 3), torch.nan)).sort().values.tolist() == [[0, 1, 2]]


def test_distances_are_zero_at_the_goal_alone(agent: Agent) -> None:
    model, goal = agent.world_model, drawn(4, 32)
    image = model.savi.decode(goal).frames
    for to_goal in (
        SlotDistance(goal),
        DynamicsDistance(model.inverse_dynamics, whitening(), goal),
        ImageDistance(model.savi, image),
    ):
        here, there = to_goal(torch.stack([goal, goal + 0.5 * drawn(4, 32, seed=1)])).tolist()
        assert here < 1e-3 * there


def test_the_dynamics_distance_adds_up_the_latent_actions(agent: Agent) -> None:
    model, slots = agent.world_model, drawn(1, 6, 4, 32)
    z = model.inverse_dynamics(slots).z[0]
    expected = whitening().turn(z.sum(0)).square().mean()
    torch.testing.assert_close(
        DynamicsDistance(model.inverse_dynamics, whitening(), slots[0, -1])(slots[0, 0]), expected
    )


def test_a_model_that_infers_nothing_has_no_dynamics_distance() -> None:
    model = tiny_agent(tiny_config("ground_truth")).world_model
    with pytest.raises(ValueError, match=r"got mode ground_truth, expected .*plan\.cost=slots"):
        DynamicsDistance(model.inverse_dynamics, whitening(), drawn(4, 32))


def test_futures_are_those_of_the_front_door(agent: Agent) -> None:
    frame, z = torch.rand(3, 64, 64, generator=torch.Generator().manual_seed(0)), 0.2 * drawn(6, 5, 8)
    model = PlaySlot(agent.world_model)
    cost = GoalCost(agent.world_model, model.parse(frame)[None], z[0, :0], SlotDistance(drawn(4, 32)))
    torch.testing.assert_close(cost.imagine(z), model.imagine(frame, z), atol=2e-7, rtol=2e-7)


def test_frames_that_were_seen_change_the_future_as_seeds_do(agent: Agent) -> None:
    model, seen, past, z = agent.world_model, drawn(3, 4, 32), drawn(2, 8), drawn(2, 4, 8)
    cost = GoalCost(model, seen, past, SlotDistance(drawn(4, 32)))
    p, v = model.inverse_dynamics.split(torch.cat([past.expand(2, 2, 8), z], 1))
    expected = model.predictor.rollout(seen.expand(2, 3, 4, 32), p, v)[:, 2:]
    torch.testing.assert_close(cost.imagine(z), expected)
    alone = GoalCost(model, seen[-1:], past[:0], SlotDistance(drawn(4, 32)))
    assert (alone.imagine(z) - expected).abs().max() > 1e-3


@pytest.mark.parametrize("along", [0.0, 0.4, 1.0])
def test_the_cost_weighs_the_end_and_the_way(agent: Agent, along: float) -> None:
    goal, z = drawn(4, 32, seed=2), drawn(5, 3, 8)
    cost = GoalCost(agent.world_model, drawn(1, 4, 32), z[0, :0], SlotDistance(goal), along, rows=2)
    way = (cost.imagine(z) - goal).square().mean((-2, -1))
    torch.testing.assert_close(cost(z), (1 - along) * way[:, -1] + along * way.mean(1))


@pytest.mark.parametrize("match", [False, True])
def test_descent_through_the_model_lowers_the_cost(agent: Agent, match: bool) -> None:
    model, start = agent.world_model, drawn(1, 4, 32)
    reachable = GoalCost(model, start, drawn(0, 8), SlotDistance(start[0])).imagine(0.3 * drawn(1, 3, 8))[0, -1]
    cost = GoalCost(model, start, drawn(0, 8), SlotDistance(reachable, match), 0.0)
    search = Search(cost, (3, 8), whitening(), torch.empty(0, 3, 8))
    plan = GradientPlanner(candidates=1, iterations=15)(search, torch.Generator().manual_seed(0))
    assert plan.costs[-1] < 0.7 * plan.costs[0]


def test_a_goal_is_parsed_as_the_next_frame() -> None:
    savi = tiny_savi().requires_grad_(False).eval()
    start, goal = torch.rand(2, 2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    state = savi(start[:, None])[1]
    tracked = savi(torch.stack([start, goal, goal], 1))[0]
    torch.testing.assert_close(goal_slots(savi, state, goal), tracked[:, 1])
    torch.testing.assert_close(goal_slots(savi, state, goal, looks=2), tracked[:, 2])


def torchrl_parts(model: WorldModel, horizon: int, along: float) -> tuple[SlotDistance, Whitening, Tensor]:
    return SlotDistance(0.1 * drawn(4, 32, seed=3)), whitening(), 0.1 * drawn(4, 32)


@torch.no_grad()
@pytest.mark.parametrize("along", [0.0, 0.3])
def test_torchrls_way_in_sees_the_same_futures_at_the_same_cost(agent: Agent, along: float) -> None:
    distance, stats, start = torchrl_parts(agent.world_model, 5, along)
    env = planning_env(agent.world_model, distance, stats, 5, along)
    actions = drawn(3, 5, 8)
    steps = iter(actions.unbind(1))
    rollout = env.rollout(
        5,
        lambda td: td.set("action", next(steps)),
        tensordict=planning_start(env, start.expand(3, 4, 32)),
        auto_reset=False,
        break_when_any_done=False,
    )
    ours = GoalCost(agent.world_model, start[None], drawn(0, 8), distance, along)
    z = latent_of(stats, actions)
    torch.testing.assert_close(rollout["next", keys.SLOTS], ours.imagine(z), atol=1e-6, rtol=2e-7)
    torch.testing.assert_close(rollout["next", "reward"].sum((1, 2)), -ours(z))


@torch.no_grad()
@pytest.mark.parametrize("name", ["cem", "mppi"])
def test_torchrls_planners_find_a_better_first_step(agent: Agent, name: str) -> None:
    from torchrl.modules.planners import CEMPlanner as TorchCEM
    from torchrl.modules.planners import MPPIPlanner as TorchMPPI

    distance, stats, start = torchrl_parts(agent.world_model, 3, 0.0)
    env = planning_env(agent.world_model, distance, stats, 3, 0.0)
    sizes = {"planning_horizon": 3, "optim_steps": 4, "num_candidates": 32, "top_k": 6}
    planner = TorchCEM(env, **sizes) if name == "cem" else TorchMPPI(env, ReturnAdvantage(), temperature=5.0, **sizes)
    found = []
    for _ in range(2):
        with global_seed(0, 0):
            found.append(planner(planning_start(env, start))["action"])
    assert torch.equal(*found)
    assert found[0].shape == (8,)
    assert found[0].isfinite().all()


def test_torchrl_is_refused_a_latent_per_slot() -> None:
    torch.manual_seed(0)
    config = tiny_config(multi=True)
    with pytest.raises(ValueError, match="got one latent action per slot"):
        planning_env(WorldModel(config.model, config.env), SlotDistance(drawn(4, 32)), whitening(), 3)


def test_our_search_takes_a_latent_per_slot() -> None:
    torch.manual_seed(0)
    config = tiny_config(multi=True)
    model = WorldModel(config.model, config.env).eval().requires_grad_(False)
    model.inverse_dynamics.split(torch.randn(64, 8))
    cost = GoalCost(model, drawn(1, 4, 32), drawn(0, 4, 8), SlotDistance(drawn(4, 32)))
    plan = CEMPlanner(iterations=2)(
        Search(cost, (3, 4, 8), whitening(), torch.empty(0, 3, 4, 8)), torch.Generator().manual_seed(0)
    )
    assert plan.latents.shape == (3, 4, 8)


def test_an_untrained_agent_has_statistics(agent: Agent) -> None:
    assert latent_statistics(agent).scale.tolist() == pytest.approx([1.0] * 8, abs=0.01)


def test_straying_from_a_proposal_costs_its_square_in_whitened_coordinates() -> None:
    """By hand: two directions of deviations 2 and 1/2, strayed from by one deviation each in one of two steps."""
    whitened = Whitening(2)
    whitened.scale.copy_(torch.tensor([2.0, 0.5]))
    proposal = drawn(2, 2)
    cost = NearProposal(lambda latents: latents.sum((1, 2)), proposal, whitened, 0.3)
    strayed = proposal + torch.tensor([[2.0, -0.5], [0.0, 0.0]])
    tried = torch.stack([proposal, strayed]).requires_grad_()
    costs = cost(tried)
    torch.testing.assert_close(costs, tried.sum((1, 2)) + torch.tensor([0.0, 0.3 * (1 + 1) / 4]))
    (gradient,) = torch.autograd.grad(costs.sum(), tried)
    assert bool((gradient[1, 0] != 1).all())
