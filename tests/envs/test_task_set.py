"""MT10: ten tasks in one environment, in turn by the episodes' seeds."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.config.compose import compose
from playslot_rl.config.metaworld import SETS, SMALL, TASKS
from playslot_rl.envs import make_env, task_config
from playslot_rl.envs.task_set import TaskSet
from playslot_rl.errors import ConfigError

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


def test_its_small_tasks_are_seen_from_near() -> None:
    config = task_config("metaworld/MT10")
    seen = {name: config.of_episode(seed).camera for seed, name in enumerate(MT10)}
    assert {name for name, camera in seen.items() if camera} == {"reach", "push", "pick-place"}
    before = replace(config, camera="")  # a world model of before
    for name in MT10:
        alone = task_config(f"metaworld/{name}")
        assert config.serves(alone)
        assert before.serves(alone) == (name not in SMALL)
        assert before.serves(replace(alone, camera=""))


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


def test_tasks_are_joined_by_their_names() -> None:
    joined = compose(["env=metaworld", "env.task=reach-v3+door-open", "preset=compact"]).env
    assert joined.tasks == ("reach", "door-open")
    assert joined.max_steps == TASKS["door-open"].steps
    assert [joined.of_episode(seed).task for seed in (6, 7)] == ["reach", "door-open"]
    assert joined == replace(task_config("metaworld/reach+door-open"), max_steps=joined.max_steps)
    for wrong, message in {
        "reach+pusch": "got 'pusch', expected Meta-World's tasks, joined; did you mean push",
        "reach+MT10": "got 'MT10', expected Meta-World's tasks, joined",
        "reach+reach": "expected each task once",
    }.items():
        with pytest.raises(ConfigError, match=re.escape(message)):
            task_config(f"metaworld/{wrong}")


def test_a_world_model_of_several_serves_each_of_them() -> None:
    several = task_config("metaworld/reach+door-open")
    served = {name: several.serves(task_config(f"metaworld/{name}")) for name in ("reach", "door-open", "push", "MT10")}
    assert served == {"reach": True, "door-open": True, "push": False, "MT10": False}
    assert several.serves(several)
    assert not task_config("metaworld/reach").serves(several)
    assert not several.serves(task_config("button_press"))


@pytest.mark.slow
def test_experts_solve_most_episodes(env: TaskSet) -> None:
    env.draw_steps, solved = False, []
    for seed in range(len(MT10)):
        env.reset(seed=seed)
        solved.append(any(env.step(env.expert_action())[4]["success"] for _ in range(env.config.max_steps)))
    assert sum(solved) >= 8, dict(zip(MT10, solved, strict=True))
