"""OGBench's cubes; what needs the package is skipped without it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.collectors.collection import playing
from playslot_rl.config import EnvConfig, RenderConfig, to_dict
from playslot_rl.config.compose import compose
from playslot_rl.envs import check_task, make_env, task_config, task_metadata
from playslot_rl.envs.culling import coarse
from playslot_rl.envs.ogbench import CLEAR, DETAIL, SPOTS, CubeTask, next_move
from playslot_rl.errors import ConfigError

TASKS = ["cube-single", "cube-double"]
ogbench = pytest.mark.skipif(find_spec("ogbench") is None, reason="needs the extra ogbench")


def made(env: EnvConfig | str, quality: str = "fast") -> CubeTask:
    task = make_env(env, RenderConfig(quality=quality)).unwrapped  # type: ignore[arg-type]
    assert isinstance(task, CubeTask)
    return task


@pytest.fixture(scope="module")
def known() -> Iterator[dict[str, CubeTask]]:
    """Both tasks: to make one takes seconds."""
    tasks = {name: made(f"ogbench/{name}") for name in TASKS}
    yield tasks
    for task in tasks.values():
        task.close()


@pytest.fixture
def single(known: dict[str, CubeTask]) -> CubeTask:
    return known["cube-single"]


def solved_after(task: CubeTask, seed: int) -> int | None:
    """Agent steps that the expert takes, of as many as an episode has; only the first frame is drawn."""
    assert not task.reset(seed=seed)[1]["success"]
    task.draw_steps = False
    steps = range(1, task.config.max_steps + 1)
    found = next((step for step in steps if task.step(task.expert_action())[4]["success"]), None)
    task.draw_steps = True
    return found


@pytest.mark.parametrize("name", TASKS)
def test_names_and_sizes_need_no_simulator(name: str) -> None:
    env = task_config(f"ogbench/{name}")
    assert env == compose(["env=ogbench", f"env.task={name}-v0"]).env
    assert (env.action_dim, env.full_name) == (5, f"ogbench_{name}")
    assert task_metadata(env)["task"]
    config = compose(["env=ogbench", f"env.task={name}"])
    assert {config.collect.expert_steps, config.collect.random_steps} == {env.max_steps}
    assert config.model.predictor.context > env.max_steps


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("env=ogbench", "env.task=cube-duoble"), "expected one of cube-single, cube-double; did you mean cube-double"),
        (("env=ogbench", "env.task=drawer-open"), "env.task: got 'drawer-open', expected one of cube-single"),
        (("env=ogbench", "env.goals=drawn"), "env.goals: got 'drawn', expected one of evaluation, random"),
        (("env=block_push", "env.goals=random"), "expected nothing with env=block_push: they are of env=ogbench"),
        (("env=metaworld", "env.targets=false"), "expected nothing with env=metaworld: they are of env=ogbench"),
    ],
)
def test_wrong_settings_are_one_line(arguments: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        compose(arguments)
    assert "\n" not in str(refused.value)


def test_without_the_package_one_line_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ogbench.manipspace.envs.cube_env", None)
    env = task_config("ogbench/cube-single")
    for use in (make_env, check_task):
        with pytest.raises(ConfigError, match=r"expected OGBench: pip install 'playslot_rl\[ogbench\]'") as got:
            use(env)
        assert "\n" not in str(got.value)


def test_other_tasks_say_nothing_of_goals() -> None:
    assert not {"goals", "targets"} & set(to_dict(EnvConfig()))


def test_the_noisy_expert_has_random_goals() -> None:
    config = compose(["env=ogbench", "collect.exploration_noise=0.3"])
    found = playing(config)
    assert (found.env.goals, found.collect.noise) == ("random", 0.3)
    assert (config.env.goals, config.collect.noise) == ("evaluation", 0.0)


def moves(cubes: list[list[float]], targets: list[list[float]]) -> list[int]:
    """Which cubes are moved, one after the other, where each move succeeds, until all are at their targets."""
    now, wanted, found = np.array(cubes), np.array(targets), []
    while (move := next_move(now, wanted)) is not None:
        cube, place = move
        others = np.delete(now, cube, 0)
        assert np.linalg.norm(others - place, axis=1).min() > 0.0399, "into another cube"
        if place[2] > 0.04:
            assert np.linalg.norm(others - place + (0.0, 0.0, 0.04), axis=1).min() < 1e-9, "into the air"
        now[cube] = place
        found.append(cube)
        assert len(found) < 9, "in circles"
    np.testing.assert_allclose(now, wanted)
    return found


def test_cubes_are_moved_in_an_order_that_works() -> None:
    left, right, middle, above = ([0.425, y, z] for y, z in ((-0.1, 0.02), (0.1, 0.02), (0.0, 0.02), (0.0, 0.06)))
    assert moves([left, right], [left, right]) == []
    assert moves([left, right], [left, middle]) == [1]
    assert moves([left, right], [above, middle]) == [1, 0]  # a stack, from below
    assert moves([left, right], [right, left]) == [1, 0, 1]  # a swap
    assert moves([middle, above], [left, right]) == [1, 0]


def test_a_cube_in_the_way_is_put_where_nothing_is_wanted() -> None:
    cubes = np.array([[0.425, -0.1, 0.02], [0.425, 0.1, 0.02]])
    move = next_move(cubes, cubes[::-1])
    assert move is not None
    assert any(np.array_equal(move[1], spot) for spot in SPOTS)
    assert np.linalg.norm(cubes - move[1], axis=1).min() > CLEAR


@ogbench
@pytest.mark.parametrize("name", TASKS)
def test_a_task_is_drawn_and_its_expert_solves_it(known: dict[str, CubeTask], name: str) -> None:
    task = known[name]
    frame = task.reset(seed=0)[0][keys.PIXELS].copy()
    assert set(range(1, 1 + len(task.objects()))) <= {*np.unique(task.segment()).tolist(), 1}
    assert solved_after(task, 0) is not None
    assert task.draw().tolist() != frame.tolist()
    np.testing.assert_array_equal(task.reset(seed=0)[0][keys.PIXELS], frame)


@ogbench
@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_the_expert_solves_all_five_goals(known: dict[str, CubeTask], name: str) -> None:
    assert None not in [solved_after(known[name], seed) for seed in range(20)]


@ogbench
def test_episodes_take_the_five_goals_in_turn(single: CubeTask) -> None:
    found = []
    for seed in range(5, 10):
        single.reset(seed=seed)
        found.append(single._simulation.cur_task_id)
    assert found == [1, 2, 3, 4, 5]


@ogbench
def test_an_episode_is_a_function_of_its_seed_and_the_look_ahead_leaves_it_alone(single: CubeTask) -> None:
    ends = []
    for looks, before in ((1, 0), (3, 7)):
        single.reset(seed=before)
        single.reset(seed=3)
        for _ in range(8):
            actions = [single.expert_action() for _ in range(looks)]
            assert all(np.array_equal(action, actions[0]) for action in actions)
            single.step(actions[0])
        data = single._simulation.data
        ends.append(np.concatenate((data.qpos, data.qvel, data.qacc_warmstart, single._state(), single._action)))
        ends[-1] = np.concatenate((ends[-1], single.draw().ravel()))
    np.testing.assert_array_equal(ends[0], ends[1])


@ogbench
@pytest.mark.integration
def test_simulation_and_full_frames_are_ogbenchs_own() -> None:
    """The frames of its `visual-` environment, which hides the targets, and what its steps lead to."""
    import gymnasium

    task = made(replace(task_config("ogbench/cube-single"), targets=False), "full")
    own = gymnasium.make("visual-cube-single-v0", terminate_at_goal=False, disable_env_checker=True).unwrapped
    frame = task.reset(seed=1)[0][keys.PIXELS]
    own.reset(seed=0, options={"task_id": task._simulation.cur_task_id})
    simulation, theirs = task._simulation, own.data  # type: ignore[attr-defined]
    for name in ("qpos", "qvel", "qacc_warmstart", "ctrl", "mocap_pos", "mocap_quat"):
        getattr(theirs, name)[:] = getattr(simulation.data, name)
    import mujoco

    mujoco.mj_forward(own.model, theirs)  # type: ignore[attr-defined]
    np.testing.assert_array_equal(own.render(), frame)
    task.draw_steps, own.compute_observation = False, lambda: None  # type: ignore[attr-defined]
    solved = False
    for _ in range(task.config.max_steps):
        action = task.expert_action()
        _, reward, _, _, info = task.step(action)
        results = [own.step(action) for _ in range(task.config.frame_skip)]
        solved |= info["success"]
        assert info["success"] == any(result[4]["success"] for result in results)
        assert reward == pytest.approx(np.mean([result[1] for result in results]))
        np.testing.assert_allclose(theirs.qpos, simulation.data.qpos, atol=1e-9)
    assert solved
    np.testing.assert_array_equal(own.render(), task.draw())
    task.close()


@ogbench
@pytest.mark.integration
def test_random_goals_follow_one_another() -> None:
    task = made(replace(task_config("ogbench/cube-double"), goals="random", max_steps=90))
    task.reset(seed=0)
    task.draw_steps = False
    seen, reached = [], []
    for _ in range(90):
        seen.append(task._targets()[task._targets()[:, 2] > 0].round(6).tolist())
        reached.append(task.step(task.expert_action())[4]["success"])
    changes = [step for step in range(1, 90) if seen[step] != seen[step - 1]]
    assert len(changes) >= 2
    assert all(len(targets) == 1 for targets in seen)
    assert all(any(reached[begin:end]) for begin, end in zip([0, *changes], changes, strict=False))
    task.close()


@ogbench
def test_coarse_meshes_look_the_same_and_leave_the_model_as_it_is(single: CubeTask) -> None:
    model = single._simulation.model
    before = [table.copy() for table in (model.mesh_face, model.mesh_facenormal, model.mesh_facenum)]
    with coarse(model, DETAIL):
        assert model.mesh_facenum.sum() < before[2].sum() / 5
        assert (model.mesh_facenum > 0).all()
    for table, kept in zip((model.mesh_face, model.mesh_facenormal, model.mesh_facenum), before, strict=True):
        np.testing.assert_array_equal(table, kept)
    single.reset(seed=1)
    difference = []
    fine = single._make_renderer(cell=0.0)
    for _ in range(6):
        single.step(single.expert_action())
        data = single._simulation.data
        difference.append(np.abs(fine(data).astype(np.int64) - single.draw()).mean())
    fine.close()
    assert max(difference) < 1.0
