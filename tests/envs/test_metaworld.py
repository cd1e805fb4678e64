"""Meta-World's tasks: each is drawn, solved by its expert, and the same whatever came before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.config import EnvConfig, to_dict
from playslot_rl.config.compose import compose, spelled
from playslot_rl.config.metaworld import NEAR, SMALL, TASKS
from playslot_rl.envs import make_env, task_config
from playslot_rl.envs.metaworld import CAMERAS, LATE, MetaWorldEnv
from playslot_rl.errors import ConfigError
from playslot_rl.runs.opening import require_task

QUICK = ("coffee-button", "drawer-open", "handle-press", "plate-slide", "reach")
TRIES = 4
"""Episodes of which an expert solves one at least."""


def made(task: str) -> MetaWorldEnv:
    env = make_env(f"metaworld/{task}").unwrapped
    assert isinstance(env, MetaWorldEnv)
    return env


@pytest.fixture(scope="module")
def reach() -> Iterator[MetaWorldEnv]:
    env = made("reach")
    yield env
    env.close()


def solved(env: MetaWorldEnv, seed: int) -> bool:
    """Whether the expert solves an episode that does not start solved; only its first frame is drawn."""
    _, info = env.reset(seed=seed)
    assert not info["success"]
    return any(env.step(env.expert_action())[4]["success"] for _ in range(env.config.max_steps))


@pytest.mark.parametrize(
    "task", [*QUICK, *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS if task not in QUICK)]
)
def test_a_task_is_drawn_and_its_expert_solves_it(task: str) -> None:
    env = made(task)
    env.draw_steps = False
    frame = env.reset(seed=0)[0][keys.PIXELS].copy()
    labels = env.segment()
    assert frame.shape == (64, 64, 3)
    assert frame.std() > 10
    assert {1, 2} <= set(np.unique(labels).tolist()), "the arm, and the first of the other things"
    assert any(solved(env, seed) for seed in range(TRIES))
    assert env.draw().tolist() != frame.tolist()
    np.testing.assert_array_equal(env.reset(seed=0)[0][keys.PIXELS], frame)
    env.close()


def test_the_experts_look_ahead_leaves_the_simulation_alone(reach: MetaWorldEnv) -> None:
    ends = []
    for looks in (1, 3):
        reach.reset(seed=3)
        for _ in range(3):
            actions = [reach.expert_action() for _ in range(looks)]
            assert all(np.array_equal(action, actions[0]) for action in actions)
            reach.step(np.array([0.5, -0.5, 0.2, 1.0], np.float32))
        data = reach._simulation.data
        ends.append(np.concatenate((data.qpos, data.qvel, data.qacc_warmstart, reach._full)))
    np.testing.assert_array_equal(ends[0], ends[1])


@pytest.mark.parametrize(
    "task",
    ["door-open", *LATE, *(pytest.param(t, marks=pytest.mark.slow) for t in TASKS if t not in ("door-open", *LATE))],
)
def test_rewards_are_metaworlds_own(task: str) -> None:
    from metaworld.env_dict import ENV_CLS_MAP

    env, theirs = made(task), ENV_CLS_MAP[f"{task}-v3"]()
    env.draw_steps = False
    env.reset(seed=7)
    theirs._set_task_called = theirs._freeze_rand_vec = True
    theirs._partially_observable = False
    theirs._last_rand_vec = env._simulation._last_rand_vec.copy()
    del theirs.sawyer_observation_space
    theirs.reset()
    rewards = []
    for _ in range(env.config.max_steps):
        action = env.expert_action()
        rewards += [(env._advance(action)[0], theirs.step(action)[1]) for _ in range(env.config.frame_skip)]
    ours, own = np.array(rewards).T
    assert np.ptp(own) > 0.1
    assert ours.sum() == pytest.approx(own.sum(), rel=0.02), "contacts differ in a few, as the hand settles once"
    env.close()
    theirs.close()


def test_a_goal_is_drawn_where_it_is(reach: MetaWorldEnv) -> None:
    seen = []
    for seed in range(4):
        reach.reset(seed=seed)
        goal = np.argwhere(reach.segment() == 1 + reach.objects().index(("goal",)))
        assert len(goal)
        seen.append((*goal.mean(axis=0), *reach._simulation._target_pos))
    rows, places = np.array(seen)[:, :2], np.array(seen)[:, 2:]
    assert np.ptp(rows, axis=0).max() > 3
    assert np.ptp(places, axis=0).max() > 0.02


def pixels(env: MetaWorldEnv) -> dict[str, int]:
    """What a goal and a loose thing have of four first frames, the median."""
    names = [name for (name, *_) in env.objects()]
    seen = [name for name in ("goal", "obj", "soccer_ball", "goal_whole") if name in names]
    counts: list[list[int]] = []
    for seed in range(4):
        env.reset(seed=seed)
        labels = env.segment()
        counts.append([int((labels == 1 + names.index(name)).sum()) for name in seen])
    env.close()
    return dict(zip(seen, np.median(counts, axis=0).tolist(), strict=True))


@pytest.mark.parametrize(
    "task", ["push", *(pytest.param(task, marks=pytest.mark.slow) for task in SMALL if task != "push")]
)
def test_small_things_have_more_pixels_from_near(task: str) -> None:
    config = task_config(f"metaworld/{task}")
    assert config.camera == NEAR
    near, far = (pixels(MetaWorldEnv(replace(config, camera=camera))) for camera in (NEAR, ""))
    assert max(far.values()) < max(near.values())
    times = 1.5 if task == "push-back" else 1.6  # nine pixels, six from far
    for name, count in near.items():
        assert count >= times * far[name] or (task == "soccer" and name == "goal"), "a marker in the net"


def test_a_camera_may_be_named_or_typed() -> None:
    shown = []
    for camera in ("", "corner2", "1.25,145,-40,-0.05,0.75,0"):
        env = make_env(EnvConfig("metaworld", task="drawer-open", camera=camera))
        shown.append(env.reset(seed=5)[0][keys.PIXELS])
        env.close()
    np.testing.assert_array_equal(shown[0], shown[2])
    assert not np.array_equal(shown[0], shown[1])


def test_a_camera_that_the_hand_carries_shows_what_is_there() -> None:
    shown = []
    for quick in (True, False):
        env = make_env(EnvConfig("metaworld", task="drawer-open", camera="gripperPOV")).unwrapped
        assert isinstance(env, MetaWorldEnv)
        if not quick:
            env._make_renderer = partial(env._make_renderer, at_rest=False)
            env.__dict__.pop("_renderer").close()
        env.reset(seed=3)
        shown.append([env.step(np.array([0.0, 1.0, -1.0, 0.0], np.float32))[0][keys.PIXELS].copy() for _ in range(6)])
        env.close()
    np.testing.assert_array_equal(*shown)


@pytest.mark.integration
def test_button_press_is_one_of_them() -> None:
    frames = []
    for config in (EnvConfig(), EnvConfig("metaworld", task="button-press")):
        env = make_env(config)
        env.reset(seed=5)
        frames.append(env.step(env.unwrapped.expert_action())[0][keys.PIXELS])  # type: ignore[attr-defined]
        env.close()
    np.testing.assert_array_equal(frames[0], frames[1])


def test_the_names_are_metaworlds_own() -> None:
    from metaworld.env_dict import ENV_CLS_MAP
    from metaworld.policies import ENV_POLICY_MAP

    assert {f"{task}-v3" for task in TASKS} == set(ENV_CLS_MAP) == set(ENV_POLICY_MAP)
    assert set(CAMERAS) < set(TASKS)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("env=metaworld", "env.task=drawr-opn"), "did you mean drawer-open or drawer-close or door-open"),
        (("env=metaworld", "env.task="), "env.task: got '', expected one of Meta-World's 51"),
        (
            ("env=metaworld", "env.camera=near"),
            "env.camera: got 'near', expected none with env.task=drawer-open",
        ),
        (("env.camera=near",), "env.camera: got 'near', expected none with env=button_press"),
        (("env.task=drawer-open",), "env.task: got 'drawer-open', expected none with env.name=button_press"),
    ],
)
def test_a_wrong_task_is_one_line(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        compose(arguments)
    assert "\n" not in str(refused.value)


def test_a_task_brings_the_length_of_its_episodes() -> None:
    for preset in ("compact", "compact_gpu", "gpu", "paper"):
        config = compose(["env=metaworld", "env.task=bin-picking-v3", f"preset={preset}"])
        steps = TASKS["bin-picking"].steps
        assert config.env == task_config("metaworld/bin-picking")
        assert {config.env.max_steps, config.collect.random_steps, config.collect.expert_steps} == {steps}
        assert config.model.predictor.context > steps
    assert compose(["env=metaworld", "env.task=bin-picking", "env.max_steps=7"]).env.max_steps == 7
    assert compose(["env=metaworld", "env.task=bin-picking", "preset=smoke"]).env.max_steps == 6


def test_a_task_is_said_and_typed_again(tmp_path: Path) -> None:
    config = compose(["env=metaworld", "env.task=bin-picking", "env.max_steps=20", f"out={tmp_path}"])
    assert to_dict(config.env)["task"] == "bin-picking"
    assert "task" not in to_dict(EnvConfig())
    assert config.env.full_name == "metaworld_bin-picking"
    assert compose(spelled(config, "collect"), "collect") == config


def test_a_run_of_another_task_is_refused() -> None:
    config = compose(["env=metaworld", "env.task=door-open"])
    with pytest.raises(ConfigError, match=r"env\.task: got door-open, expected reach"):
        require_task(config, task_config("metaworld/reach"))
