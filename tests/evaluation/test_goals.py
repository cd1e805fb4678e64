"""Goals from the expert's episodes: the same layout, starts that are not solved, and traces of what happened."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from playslot_rl.acting.actor import ExpertActor, RandomActor
from playslot_rl.acting.episodes import TaskPool
from playslot_rl.config import PlanConfig, RenderConfig
from playslot_rl.config.env import EnvConfig
from playslot_rl.errors import ConfigError
from playslot_rl.evaluation.goals import GoalPool, distance, make_goals
from playslot_rl.evaluation.planning import cost_along_solution, play, results, shape, ways_of_acting
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.visualization.document import to_markdown
from playslot_rl.visualization.planning_page import planning_page

SEEDS = (1_000_000_500, 1_000_000_503)
ENV = EnvConfig(warmup_steps=2)


@pytest.fixture(scope="module")
def pool() -> Iterator[GoalPool]:
    with GoalPool(ENV, RenderConfig()) as made:
        yield made


@pytest.mark.integration
def test_the_expert_reaches_the_goals_that_are_its_own(pool: GoalPool) -> None:
    goals = make_goals(pool, SEEDS, "solved", PlanConfig(), 0)
    assert [goal.seed for goal in goals] == list(SEEDS)
    played = play(pool, ExpertActor(), goals, "solved", ENV.max_steps, 1, draw=True)
    found = results(played, goals, 0.05)
    assert found["success_rate"] == found["state_success_rate"] == 1.0
    assert found["state_distance"] < 1e-6
    assert found["state_distance_at_start"] > 0.05
    for goal, trace in zip(goals, played.traces, strict=True):
        assert np.array_equal(goal.frames[0], trace.frames[0]), "the same seed, the same layout"
        assert np.array_equal(goal.places, np.stack(trace.places))


@pytest.mark.integration
def test_a_goal_ahead_begins_where_the_expert_was(pool: GoalPool) -> None:
    goals = make_goals(pool, SEEDS, "ahead", PlanConfig(), 0)
    again = make_goals(pool, SEEDS, "ahead", PlanConfig(), 0)
    assert [goal.start for goal in goals] == [goal.start for goal in again]
    assert all(len(goal.frames) == 6 and distance(goal.places[0], goal.places[-1]) >= 0.05 for goal in goals)
    assert any(goal.start > 0 for goal in goals)
    played = play(pool, ExpertActor(), goals, "ahead", 10, 1, draw=False)
    for goal, trace in zip(goals, played.traces, strict=True):
        assert len(trace.places) == 11
        assert np.array_equal(goal.frames[0], trace.frames[0])
        np.testing.assert_allclose(np.stack(trace.places)[:6], goal.places, atol=1e-9)
    assert results(played, goals, 0.05)["state_success_rate"] == 1.0


def test_no_goal_at_all_is_refused(pool: GoalPool) -> None:
    pool.env = ENV
    with pytest.raises(ConfigError, match=r"plan\.goals=ahead: got no goal from the expert's 1 episodes"):
        make_goals(pool, SEEDS[:1], "ahead", PlanConfig(near=5.0), 0)
    pool.env = replace(ENV, max_steps=2)
    with pytest.raises(ConfigError, match=r"plan\.goals=solved: got no goal"):
        make_goals(pool, SEEDS[:1], "solved", PlanConfig(), 0)
    pool.env = ENV


def test_random_actions_last_as_long_as_the_budget() -> None:
    config, agent = tiny_config(), tiny_agent()
    config = replace(config, env=ENV, plan=PlanConfig(planner=("cem",), budget=20 * ENV.frame_skip * ENV.max_steps))
    random = ways_of_acting(config, agent, "ahead", [])["random"]
    assert isinstance(random, RandomActor)
    assert random.steps == 20 * ENV.max_steps


def test_curves_are_told_by_their_end_their_slope_and_their_top() -> None:
    ways = [[2.0, 1.0, 0.0], [1.0, 3.0, 2.0]]
    assert shape(ways) == {"goal_is_minimum": 0.5, "downhill": 0.75, "hill": 2.0, "curves": ways}


@pytest.mark.integration
def test_the_cost_along_the_way_and_the_table(pool: GoalPool) -> None:
    goals = make_goals(pool, SEEDS, "ahead", PlanConfig(), 0)
    found = cost_along_solution(tiny_agent(), goals, looks=2)
    for name in ("slots", "dynamics", "image"):
        assert [len(way) for way in found[name]["curves"]] == [6, 6]
        assert found[name] == shape(found[name]["curves"])
    assert found["moved"] > 0
    random = results(play(pool, RandomActor(10, 4), goals, "ahead", 10, 1, draw=False), goals, 0.05)
    settings = {"ahead": 25, "budget": 50}
    part = {"episodes": 2, "max_steps": 10, "size": {"horizon": 5}, "rows": {"random": random, "cem-policy": random}}
    report = {"run": "runs/x", "command": "playslot plan", "settings": settings}
    page = to_markdown(planning_page({**report, "goals": {"ahead": {**part, "cost_along_solution": found}}}))
    assert "| random actions | " in page
    assert "| CEM from the policy | " in page
    assert "25 environment steps ahead, budget 50" in page


@pytest.mark.parametrize("name", ["button_press", "block_push_easy"])
def test_tasks_say_where_things_are(name: str) -> None:
    with TaskPool(EnvConfig(name, warmup_steps=0), RenderConfig()) as made:
        task = made.take(1)[0]
        task.reset(seed=3)
        before = task.places()  # type: ignore[attr-defined]
        task.step(task.expert_action())
        after = task.places()  # type: ignore[attr-defined]
    assert before.keys() == after.keys()
    hand = next(iter(before))
    assert 0.001 < float(np.linalg.norm(after[hand] - before[hand])) < 0.3
