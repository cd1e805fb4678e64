"""MT10: ten tasks in one environment, in turn by the episodes' seeds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.config.compose import compose
from playslot_rl.config.metaworld import SETS, TASKS
from playslot_rl.envs import make_env, task_config
from playslot_rl.envs.task_set import TaskSet

MT10 = SETS["MT10"]


@pytest.fixture(scope="module")
def env() -> Iterator[TaskSet]:
    made = make_env("metaworld/MT10").unwrapped
    assert isinstance(made, TaskSet)
    yield made
    made.close()


def test_the_names_are_metaworlds_own() -> None:
    from metaworld.env_dict import MT10_V3

    assert [f"{name}-v3" for name in MT10] == list(MT10_V3)


def test_episodes_take_the_tasks_in_turn() -> None:
    config = task_config("metaworld/MT10")
    assert [config.of_episode(seed).task for seed in range(30, 50)] == [*MT10, *MT10]
    assert len({*config.sentences}) == len(MT10), "data sets tell them apart by their words"
    assert task_config("metaworld/reach").of_episode(7) == task_config("metaworld/reach")


def test_it_lasts_as_long_as_its_longest_task() -> None:
    longest = max(TASKS[name].steps for name in MT10)
    for preset in ("compact", "paper"):
        config = compose(["env=metaworld", "env.task=MT10", f"preset={preset}"])
        assert {config.env.max_steps, config.collect.expert_steps, config.collect.random_steps} == {longest}
        assert config.model.predictor.context > longest


def test_an_episode_is_that_of_its_task_alone(env: TaskSet) -> None:
    env.reset(seed=14)  # another comes before
    for seed in (3, 14):
        alone = make_env(env.config.of_episode(seed)).unwrapped
        shown = [one.reset(seed=seed)[0][keys.PIXELS] for one in (env, alone)]
        acted = [one.expert_action() for one in (env, alone)]  # type: ignore[attr-defined]
        moved = [one.step(acted[0])[0] for one in (env, alone)]
        np.testing.assert_array_equal(*shown)
        np.testing.assert_array_equal(*acted)
        np.testing.assert_array_equal(moved[0][keys.PIXELS], moved[1][keys.PIXELS])
        assert env.objects() == alone.objects()  # type: ignore[attr-defined]
        assert env.places().keys() == alone.places().keys()  # type: ignore[attr-defined]
        np.testing.assert_array_equal(env.segment(), alone.segment())  # type: ignore[attr-defined]
        alone.close()


@pytest.mark.slow
def test_experts_solve_most_episodes(env: TaskSet) -> None:
    env.draw_steps, solved = False, []
    for seed in range(len(MT10)):
        env.reset(seed=seed)
        solved.append(any(env.step(env.expert_action())[4]["success"] for _ in range(env.config.max_steps)))
    assert sum(solved) >= 8, dict(zip(MT10, solved, strict=True))
