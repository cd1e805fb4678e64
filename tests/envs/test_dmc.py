"""The tasks of the DeepMind Control Suite; what needs dm-control is skipped without it."""

from __future__ import annotations

import sys
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest

from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.config.compose import compose
from playslot_rl.envs import check_task, dmc_ids, make_env, make_torchrl_env, task_config, task_metadata
from playslot_rl.errors import ConfigError

NAMES = ["dmc_ball_in_cup_catch", "dmc_cartpole_balance"]
suite = pytest.mark.skipif(find_spec("dm_control") is None, reason="needs the extra dmc")


def played(name: str, seed: int, quality: str = "fast", steps: int = 500) -> tuple[list[Any], list[float], bool]:
    """Frames and rewards of random actions, and whether the episode ended with the last of them."""
    task: Any = make_env(name, RenderConfig(quality=quality)).unwrapped
    rng = np.random.default_rng(0)
    frames, rewards, over = [task.reset(seed=seed)[0]["pixels"]], [], False
    task.draw_steps = steps < 10
    for _ in range(steps):
        assert not over
        observation, reward, terminated, over, info = task.step(rng.uniform(-1, 1, task.config.action_dim))
        assert not terminated
        assert not info["success"]
        frames.append(observation["pixels"])
        rewards.append(reward)
    task.close()
    return frames, rewards, over


@pytest.mark.parametrize("name", NAMES)
def test_names_sizes_and_facts_need_no_simulator(name: str) -> None:
    env = task_config(name)
    assert env == compose([f"env={name}"]).env
    assert env in [config for _, config in dmc_ids().values()]
    assert (env.frame_skip * env.max_steps, env.image_size) == (1000, 64)
    assert task_metadata(env)["task"] != "Collect the task's rewards."


def test_without_the_package_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "dm_control", None)
    with pytest.raises(ConfigError, match=r"expected dm-control: pip install 'playslot_rl\[dmc\]'") as got:
        make_env("dmc_cartpole_balance")
    assert "\n" not in str(got.value)


def test_a_command_that_needs_an_expert_is_refused_before_it_begins() -> None:
    env = task_config("dmc_cartpole_balance")
    check_task(env)
    with pytest.raises(ConfigError, match="got a task without an expert"):
        check_task(env, expert=True)
    with pytest.raises(ConfigError, match=r"env\.action_dim: got 4, expected 1"):
        check_task(replace(env, action_dim=4))


@suite
@pytest.mark.integration
@pytest.mark.parametrize("name", NAMES)
def test_returns_and_full_frames_are_the_suites_own(name: str) -> None:
    """The same start and actions, each for two steps, in dm-control alone."""
    from dm_control import suite as control

    seed = 3
    _, rewards, over = played(name, seed)
    frames, _, _ = played(name, seed, "full", 3)
    assert over
    assert len(rewards) == 500

    drawn = np.random.default_rng(np.random.SeedSequence(seed).spawn(2)[0]).integers(2**32)
    domain, _, task = name.removeprefix("dmc_").rpartition("_")
    own = control.load(domain, task, task_kwargs={"random": np.random.RandomState(int(drawn))})
    own.reset()
    rng = np.random.default_rng(0)
    total = 0.0
    for step in range(500):
        if step < len(frames):
            np.testing.assert_array_equal(own.physics.render(64, 64, camera_id=0), frames[step])
        action = rng.uniform(-1, 1, own.action_spec().shape).astype(np.float32)
        for _ in range(2):
            arrived = own.step(action)
            total += arrived.reward
    assert arrived.last()
    assert sum(rewards) == pytest.approx(total, rel=1e-9)


@suite
@pytest.mark.integration
def test_an_episode_is_a_function_of_its_seed() -> None:
    first, again, other = (played("dmc_cartpole_balance", seed, steps=3) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first[0], again[0])
    assert first[1] == again[1] != other[1]


@suite
@pytest.mark.integration
def test_torchrl_reads_as_many_actions_as_the_task_has() -> None:
    env = make_torchrl_env("dmc_ball_in_cup_catch")
    rollout = env.rollout(2)
    assert rollout["pixels"].shape == (2, 3, 64, 64)
    assert rollout["action"].shape == (2, 2)
    env.close()


@suite
@pytest.mark.integration
@pytest.mark.parametrize(
    ("env", "message"),
    [
        (replace(task_config("dmc_cartpole_balance"), action_dim=4), "env.action_dim: got 4, expected 1"),
        (EnvConfig("dmc_cartpole_stand"), "unknown environment: got 'dmc_cartpole_stand'"),
    ],
)
def test_what_does_not_fit_is_refused(env: EnvConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_env(env)


@suite
@pytest.mark.integration
def test_there_is_no_expert() -> None:
    made: Any = make_env("dmc_cartpole_balance").unwrapped
    with pytest.raises(ConfigError, match="got a task without an expert"):
        made.expert_action()
    assert set(made.places()) == {"cart", "pole_1"}
    assert made.objects() == (("cart",),)
    made.close()
