"""`env.variation.*`: the picture changes, the task does not; off, nothing does."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.config import EnvConfig, to_dict
from playslot_rl.config.compose import compose
from playslot_rl.config.env import VariationConfig
from playslot_rl.envs import make_env, task_config
from playslot_rl.envs.pixel_task import PixelTask
from playslot_rl.envs.variation import Wobble, pattern
from playslot_rl.errors import ConfigError

TASKS = ("button_press", "block_push_easy")
EACH: dict[str, dict[str, Any]] = {
    "background": {"background": True},
    "textures": {"textures": True},
    "shake": {"shake": 1.0},
    "light": {"light": 1.0},
    "colours": {"colours": 0.8},
    "object": {"object": True},
}
ALL = {key: value for one in EACH.values() for key, value in one.items()}
STEPS = 4


def made(task: str, **variation: Any) -> PixelTask:
    config = replace(task_config(task), image_size=32, variation=VariationConfig(**variation))
    found = make_env(config).unwrapped
    assert isinstance(found, PixelTask)
    return found


def episode(env: PixelTask, seed: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """Frames and states of the expert."""
    seen = [env.reset(seed=seed)[0]]
    seen += [env.step(env.expert_action())[0] for _ in range(STEPS)]
    return np.stack([one["pixels"] for one in seen]), np.stack([one[keys.STATE] for one in seen])


@pytest.fixture(scope="module", params=TASKS)
def plain(request: pytest.FixtureRequest) -> Iterator[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
    """Frames and states without a variation, and which pixels show what."""
    env = made(request.param)
    frames, states = episode(env)
    yield request.param, frames, states, env.segment()
    env.close()


@pytest.mark.parametrize("name", [*EACH, "all"])
def test_each_changes_the_picture_and_nothing_else(name: str, plain: Any) -> None:
    """The simulation is the same bit for bit; another episode looks otherwise, the same one the same."""
    task, frames, states, _ = plain
    env = made(task, **EACH.get(name, ALL))
    varied, same = episode(env)
    np.testing.assert_array_equal(same, states)
    assert (varied != frames).any(axis=-1).mean() > 0.01
    np.testing.assert_array_equal(env.draw(), varied[-1])
    other = episode(env, 4)[0]
    np.testing.assert_array_equal(episode(env)[0], varied)
    assert not np.array_equal(other, varied)
    env.close()
    seeded = made(task, **EACH.get(name, ALL), seed=1)
    again, still = episode(seeded)
    np.testing.assert_array_equal(still, states)
    assert not np.array_equal(again, varied)
    seeded.close()


@pytest.mark.parametrize("name", ["background", "textures"])
def test_what_is_painted_over_is_never_what_the_task_is_about(name: str, plain: Any) -> None:
    """Pixels of robot and objects stay as they are; edges, and gaps narrower than a pixel, are mixed."""
    task, frames, _, labels = plain
    env = made(task, **EACH[name])
    varied = episode(env)[0][-1]
    np.testing.assert_array_equal(env.segment(), labels)
    changed = np.abs(varied.astype(int) - frames[-1]).max(axis=-1) > 0
    inside = labels > 0
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        inside &= np.roll(labels, shift, (0, 1)) == labels
    assert inside.sum() > 5
    assert changed[inside].mean() < 0.05
    assert changed[labels == 0].mean() > 0.15
    env.close()


def test_the_background_and_the_object_move() -> None:
    for name in ("background", "object"):
        env = made("block_push_easy", **EACH[name])
        frames = episode(env)[0]
        rest = env.config.image_size // 4
        assert all(not np.array_equal(a[:rest], b[:rest]) for a, b in pairwise(frames)), name
        env.close()


def test_colours_leave_the_tasks_objects_alone(plain: Any) -> None:
    task, frames, _, labels = plain
    env = made(task, **EACH["colours"])
    varied = episode(env)[0][-1].astype(int)
    whole = labels > 1
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        whole &= np.roll(labels, shift, (0, 1)) == labels
    assert whole.any()
    assert np.abs(varied - frames[-1])[whole].max() <= 1
    env.close()


def test_an_environment_that_closes_leaves_no_trace() -> None:
    """Off after on, in one process, is what it was before."""
    first = made("button_press")
    before = episode(first)[0]
    varied = made("button_press", **ALL)
    episode(varied)
    varied.close()
    np.testing.assert_array_equal(episode(first)[0], before)
    first.close()


def test_what_is_collected_has_it_and_the_same_actions() -> None:
    from playslot_rl.collectors.episodes import record
    from playslot_rl.collectors.journal import CollectionSpec

    episodes = []
    for more in ([], ["env.variation.background=true"]):
        spec = CollectionSpec.make(compose(["env=block_push_easy", "preset=smoke", *more]), "expert", 1, 3, 0)
        episodes += record(spec, [0])
        assert ("variation" in spec.to_dict()["env"]) == bool(more)
    np.testing.assert_array_equal(episodes[1].actions, episodes[0].actions)
    assert not np.array_equal(episodes[1].frames, episodes[0].frames)


@pytest.mark.parametrize("name", ["PointMaze_UMaze-v3", "AdroitHandPen-v1"])
def test_of_a_gymnasium_robot_planes_and_sky_alone_are_painted_over(name: str) -> None:
    """Nobody says which of its geoms is a wall, a goal or a part of the robot."""
    import mujoco

    task = make_env(compose(["env=gym", f"env.id={name}", "env.image_size=32"]).env).unwrapped
    assert isinstance(task, PixelTask)
    first = task.reset(seed=0)[0]
    number, kind = np.moveaxis(task._renderer.parts(task._simulation.data), -1, 0)
    model, is_geom = task._simulation.model, kind == int(mujoco.mjtObj.mjOBJ_GEOM)
    free = (kind == -1) | (is_geom & (model.geom_type[number.clip(0)] == mujoco.mjtGeom.mjGEOM_PLANE))
    kept = ~free
    for shift in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        kept &= ~np.roll(free, shift, (0, 1))
    assert kept.sum() > 20
    for painted in ({"background": True}, {**ALL, "textures": False, "colours": 0.0}):
        varied = make_env(replace(task.config, variation=VariationConfig(**painted))).unwrapped
        other = varied.reset(seed=0)[0]
        np.testing.assert_array_equal(first[keys.STATE], other[keys.STATE])
        changed = np.abs(first["pixels"].astype(int) - other["pixels"]).max(axis=-1) > 0
        assert changed[free].mean() > 0.3
        if "shake" not in painted:
            assert changed[kept].mean() < 0.05
        varied.close()
    task.close()


def test_off_is_unsaid() -> None:
    assert "variation" not in to_dict(EnvConfig())
    on = replace(EnvConfig(), variation=VariationConfig(shake=0.5))
    assert to_dict(on)["variation"] == {"shake": 0.5}
    assert compose(["env.variation.shake=0.5"]).env == replace(compose([]).env, variation=on.variation)
    assert not VariationConfig(seed=3).on


def test_a_pattern_has_no_seam_and_paths_stay_within_bounds() -> None:
    drawn = pattern(np.random.default_rng(0), 64).astype(int)
    within = np.abs(np.diff(drawn, axis=0)).mean()
    assert np.abs(drawn[0] - drawn[-1]).mean() < 2 * within
    assert drawn.std() > 10
    path = np.stack([Wobble(np.random.default_rng(0), 3)(step) for step in range(500)])
    assert np.abs(path).max() <= 1
    assert np.ptp(path, axis=0).min() > 0.8


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["env.variation.shake=1.5"], r"env\.variation\.shake: got 1\.5, expected 0 \(off\) to 1"),
        (["env=grid_shapes", "env.variation.background=true"], "which no simulator draws"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(given: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(given)
