"""Any registered Gymnasium environment as a task."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import gym_examples
import gymnasium as gym
import numpy as np
import pytest

from playslot_rl import keys
from playslot_rl.collectors.episodes import record
from playslot_rl.collectors.journal import CollectionSpec
from playslot_rl.config import EnvConfig, RenderConfig
from playslot_rl.config.compose import compose
from playslot_rl.config.env import VariationConfig
from playslot_rl.envs import check_task, make_env, task_metadata
from playslot_rl.envs.gym_facts import facts, flat
from playslot_rl.envs.gym_task import GymTask, short_seed
from playslot_rl.errors import ConfigError
from playslot_rl.seeds.episodes import Stream, episode_seed

ROBOTS = {"FetchReach-v4": 4, "PointMaze_UMaze-v3": 2, "AdroitHandDoor-v1": 28}
LINE = gym_examples.register("Line-v0")


def line(**changes: Any) -> EnvConfig:
    return replace(EnvConfig("gym", 32, 1, 1, 8, 0, id=LINE), **changes)


def made(config: EnvConfig) -> GymTask:
    task = make_env(config).unwrapped
    assert isinstance(task, GymTask)
    return task


@pytest.mark.parametrize(("name", "width"), ROBOTS.items())
def test_a_registered_robot_is_a_task(name: str, width: int) -> None:
    """Reset, a step, a frame that is no flat colour, drawn as often as wanted without a change."""
    config = compose(["env=gym", f"env.id={name}", "env.image_size=32"]).env
    assert config.action_dim == width
    task = made(config)
    first, _ = task.reset(seed=3)
    assert first["pixels"].std() > 5
    observation, reward, *_, info = task.step(np.full(width, 0.5, np.float32))
    np.testing.assert_array_equal(task.draw(), observation["pixels"])
    assert np.isfinite(reward)
    assert task.solves
    assert info["success"] is False
    np.testing.assert_array_equal(task.reset(seed=3)[0]["pixels"], first["pixels"])
    assert not np.array_equal(task.reset(seed=4)[0][keys.STATE], first[keys.STATE])
    assert task.segment().max() >= 1
    task.close()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "width"), ROBOTS.items())
def test_its_episodes_do_not_depend_on_being_looked_at(name: str, width: int) -> None:
    config = compose(["env=gym", f"env.id={name}", "env.image_size=32", "env.frame_skip=2", "env.max_steps=50"]).env
    task, actions, ends = made(config), np.random.default_rng(0).uniform(-1, 1, (50, width)).astype(np.float32), []
    for draw in (True, False):
        task.draw_steps = draw
        task.reset(seed=1)
        for action in actions:
            observation, _, _, truncated, _ = task.step(action)
        assert truncated
        ends.append(observation[keys.STATE])
    np.testing.assert_array_equal(*ends)
    task.close()


def test_actions_are_stretched_over_the_box_and_experts_scaled_back() -> None:
    task = made(line(expert="gym_examples:to_the_right"))
    task.reset(seed=0)
    for given, meant in ((-1.0, -2.0), (0.0, 1.0), (1.0, 4.0)):
        task.step(np.array([given], np.float32))
        assert task.inner.unwrapped.taken == pytest.approx(meant)  # type: ignore[attr-defined]
    action = task.expert_action()
    np.testing.assert_array_equal(task.expert_action(), action)
    assert action == pytest.approx(0.0, abs=0.02)
    task.step(action)
    assert not np.array_equal(task.expert_action(), action)
    task.close()


def test_one_that_draws_itself_is_area_averaged_and_rests_where_it_ended() -> None:
    task = made(line(max_steps=20))
    frame = task.reset(seed=0)[0]["pixels"]
    assert frame.shape == (32, 32, 3)
    assert frame.mean() == pytest.approx(task.inner.render().mean(), abs=2.0)  # type: ignore[union-attr]
    rewards = [task.step(np.ones(1, np.float32))[1] for _ in range(20)]
    assert rewards[0] == 1.0
    assert rewards[-1] == 0.0
    assert task.inner.unwrapped.place > gym_examples.GOAL  # type: ignore[attr-defined]
    task.close()


def test_without_a_measure_of_success_episodes_have_a_return() -> None:
    from playslot_rl.acting.actor import ExpertActor, RandomActor
    from playslot_rl.acting.episodes import TaskPool, run_episodes
    from playslot_rl.evaluation.success import run_references, summary

    with TaskPool(line(), RenderConfig()) as pool:
        outcomes = run_episodes(pool, RandomActor(8, 1), [1, 2])
        config = compose(["preset=smoke", "env=gym", f"env.id={LINE}", "env.image_size=32", "env.max_steps=8"])
        references = run_references(None, config, [1, 2], pool)
    assert [(o.success, o.steps, o.total) for o in outcomes] == [(None, None, 8.0)] * 2
    assert summary(outcomes)["success_rate"] is None
    assert summary(outcomes)["mean_return"] == 8.0
    assert references["expert"]["success_rate"] is None
    assert "mean_return" not in references["expert"]
    with TaskPool(line(expert="gym_examples:to_the_right"), RenderConfig()) as pool:
        assert run_episodes(pool, ExpertActor(), [1])[0].plain() == {
            "seed": 1, "success": None, "steps": None, "redrawn": 0, "total": 8.0,
        }  # fmt: skip


def test_an_episode_that_starts_solved_is_known_by_its_goal() -> None:
    """FetchReach's own info says it after a step, and not after a reset."""
    task = made(compose(["env=gym", "env.id=FetchReach-v4", "env.image_size=32"]).env)
    task.draw_resets, starts = False, []
    for seed in range(200):
        info = task.reset(seed=seed)[1]
        goal = task.inner.unwrapped.goal  # type: ignore[attr-defined]
        starts.append((info["success"], bool(np.linalg.norm(task._observation["achieved_goal"] - goal) < 0.05)))
    assert sum(solved for solved, _ in starts) > 0
    assert all(solved == near for solved, near in starts)
    task.close()


def test_the_users_expert_solves_the_users_task() -> None:
    typed = ["env=gym", "env.id=FetchReach-v4", "env.image_size=32", "preset=smoke"]
    config = compose([*typed, "expert=gym_examples:reach"], "collect")
    assert config == compose([*typed, "env.expert=gym_examples:reach"], "collect")
    spec = CollectionSpec.make(config, "expert", 1, 12, 0)
    (episode,) = record(spec, [0])
    assert episode.success.any()
    assert episode.states.shape == (13, 16)
    assert task_metadata(config.env)["control_hz"] == 25


@pytest.mark.integration
def test_random_videos_need_no_expert(tmp_path: Path) -> None:
    from playslot_rl.recipes import collect

    arguments = ["env=gym", f"env.id={LINE}", "env.image_size=32", "preset=smoke", "policy=random", "episodes=2"]
    collect.main(compose([*arguments, "workers=1", f"out={tmp_path / 'set'}"]))
    assert (tmp_path / "set" / "meta" / "info.json").is_file()


UNBOUNDED = gym.spaces.Box(-np.inf, np.inf, (2,), np.float32)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            ["env.id=FetchReech-v4"],
            r"got 'FetchReech-v4', expected a registered id; the nearest are FetchReach\S+, .*, .*",
        ),
        (["env.id=LineDiscrete-v0"], r"got actions Discrete\(2\), expected a Box of real numbers"),
        (["env.id=LineUnbounded-v0"], "expected bounds below and above"),
        (["env.id=LineBlind-v0"], r"got render_modes \['human'\], expected rgb_array among them"),
        (["env.id=LineBroken-v0"], "expected an environment that can be made"),
        (["env.id=LineGrey-v0"], r"got float64 \(4, 4\) from render\(\), expected a picture"),
        (["env.id=LineReset-v0"], r"got RuntimeError \(no licence\), expected .* whose first reset, steps and picture"),
        (["env.id=LineStep-v0"], "env.id=LineStep-v0: got RuntimeError .* work: mend it, install what it needs"),
        (["env.id=LineRender-v0"], r"env\.id=LineRender-v0: got RuntimeError"),
        ([f"env.id={LINE}", "env.expert=gym_examples:nobody"], "env.expert: got 'gym_examples:nobody'"),
        ([f"env.id={LINE}", "env.expert=gym_examples:NOTHING"], "no function"),
    ],
)
def test_what_cannot_be_a_task_is_refused_in_one_line(given: list[str], message: str) -> None:
    gym_examples.register("LineDiscrete-v0", space=gym.spaces.Discrete(2))
    gym_examples.register("LineUnbounded-v0", space=UNBOUNDED)
    gym_examples.register("LineBlind-v0", modes=["human"])
    gym_examples.register("LineBroken-v0", unknown=1)
    gym_examples.register("LineGrey-v0", picture=np.zeros((4, 4)))
    for where in ("reset", "step", "render"):
        gym_examples.register(f"Line{where.title()}-v0", fails=where)
    with pytest.raises(ConfigError, match=message) as caught:
        compose(["env=gym", *given])
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (line(id=""), "env.id: got nothing"),
        (line(action_dim=3), "env.action_dim: got 3, expected 1"),
        (line(camera="front"), "env.camera: got 'front', expected none"),
        (line(id="FetchReach-v4", action_dim=4, camera="hed_camera_rgb"), "did you mean env.camera=head_camera_rgb"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(config: EnvConfig, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        make_env(config).reset(seed=0)
    assert "\n" not in str(caught.value)


def test_an_expert_or_success_that_there_is_not_is_refused_where_it_is_asked_for() -> None:
    config = compose(["env=gym", f"env.id={LINE}", "preset=smoke"])
    check_task(config.env)
    with pytest.raises(ConfigError, match=r"env\.expert: got nothing with env\.id=Line-v0"):
        CollectionSpec.make(config, "expert", 1, 2, 0)
    with pytest.raises(ConfigError, match="whose info says no success"):
        check_task(config.env, success=True)
    for wrong, said in (
        ("too_many", "expected 1 finite numbers"),
        ("too_far", r"got .*4\.1.*, expected it in Box\(-2"),
        ("of_one", r"env\.expert=gym_examples:of_one: got TypeError \(.*\), expected a function \(observation, info"),
        ("forgetful", r"got KeyError \('goal'\), expected .* gives 1 numbers"),
        ("in_words", r"got ValueError \(.*'right'\), expected"),
    ):
        with pytest.raises(ConfigError, match=said):
            check_task(line(expert=f"gym_examples:{wrong}"), expert=True)
    check_task(line(expert="gym_examples:to_the_right"), expert=True)


def test_a_camera_or_a_variation_that_there_is_not_is_refused_before_anything_is_trained() -> None:
    """Also where nobody asks for an expert, since demonstrations are given."""
    varied = VariationConfig(background=True)
    for config, said in (
        (line(camera="front"), "env.camera: got 'front', expected none"),
        (line(variation=varied), r"env\.variation: got background, .* draws itself"),
        (
            line(id="FetchReach-v4", action_dim=4, variation=VariationConfig(textures=True)),
            "env.variation: got textures, expected neither textures",
        ),
        (line(id="FetchReach-v4", action_dim=4, camera="hed_camera_rgb"), "did you mean env.camera=head_camera_rgb"),
    ):
        with pytest.raises(ConfigError, match=said):
            check_task(config)
    check_task(line(id="FetchReach-v4", action_dim=4, camera="head_camera_rgb", variation=varied))


def test_episodes_are_recorded_as_long_as_they_are_evaluated() -> None:
    for typed, steps in ((), 50), (("env.max_steps=30",), 30):
        config = compose(["env=gym", f"env.id={LINE}", *typed])
        assert (config.env.max_steps, config.collect.random_steps, config.collect.expert_steps) == (steps,) * 3
        assert (config.model.predictor.context, config.dynamics.predicted_frames) == (steps + 4, 18)
    typed = ("env.max_steps=30", "collect.random_steps=7", "model.predictor.context=9")
    config = compose(["env=gym", f"env.id={LINE}", *typed])
    assert (config.collect.random_steps, config.collect.expert_steps, config.model.predictor.context) == (7, 30, 9)


def test_without_a_typed_length_episodes_are_as_long_as_those_of_the_environment() -> None:
    name = gym_examples.register("LineShort-v0", limit=30)
    for typed, steps in (
        ((), 30),
        (("env.frame_skip=4",), 8),
        (("env.max_steps=12",), 12),
        (("env.action_dim=1",), 30),
        (("preset=smoke",), 6),
    ):
        config = compose(["env=gym", f"env.id={name}", *typed])
        assert (config.env.max_steps, config.collect.random_steps, config.env.action_dim) == (steps, steps, 1)


def test_a_return_does_not_shrink_with_the_length_of_an_agent_step() -> None:
    """Where success is measured rewards stay means."""
    late = gym_examples.register("LineLate-v0", says="is_success")
    for name, reward in ((LINE, 4.0), (late, 1.0)):
        task = made(line(id=name, frame_skip=4))
        task.reset(seed=0)
        assert task.step(np.zeros(1, np.float32))[1] == reward
        task.close()


@pytest.mark.parametrize(("name", "says", "typed"), [("LineLate-v0", "is_success", ""), ("LineTold-v0", "won", "won")])
def test_success_may_be_said_in_the_last_step_alone(name: str, says: str, typed: str) -> None:
    config = line(id=gym_examples.register(name, says=says), success=typed, max_steps=20)
    check_task(config, success=True)
    task = made(config)
    assert task.reset(seed=0)[1] == {"success": False}
    said = [task.step(np.ones(1, np.float32))[4]["success"] for _ in range(12)]
    assert said == sorted(said)
    assert said[0] is False
    assert said[-1] is True
    task.close()
    with pytest.raises(ConfigError, match=r"name another entry \(env\.success=\)"):
        check_task(line(id=gym_examples.register("LineTold-v0", says="won")), success=True)


def test_a_success_that_no_info_has_is_warned_of() -> None:
    """It may come later than in a trial, or never."""
    told = gym_examples.register("LineTold-v0", says="won")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        facts(told)
    with pytest.warns(RuntimeWarning, match=r"env\.success=wonn: got no such entry in .* one of won"):
        check_task(line(id=told, success="wonn"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        check_task(line(id=told, success="wonn"))  # once is enough
        check_task(line(id=told, success="won"))


@pytest.mark.parametrize("lost", ["place", "reward"])
def test_numbers_that_are_none_are_refused_where_they_come(lost: str) -> None:
    task = made(line(id=gym_examples.register(f"LineLost{lost}-v0", lost=lost)))
    task.reset(seed=3)
    with pytest.raises(ConfigError, match=r"env.id=LineLost.*NaN or infinite in agent step 1 of episode 3"):
        task.step(np.zeros(1, np.float32))
    task.close()


def test_a_misspelt_id_names_what_can_be_typed() -> None:
    gym_examples.register("LineOld-v0")
    gym_examples.register("LineOld-v1")
    with pytest.raises(ConfigError, match=r"nearest are (?!.*LineOld-v0).*gym_examples:LineOld-v1"):
        facts("gym_examples:LineOdl-v0")


def test_each_stream_has_its_own_short_seeds() -> None:
    numbers = [
        episode_seed(stream, seed, index)
        for stream in get_args(Stream)
        for seed in (0, 1, 294, 999, 1000, 4242, 2**31, 2**31 + 1, 2**32 - 1)
        for index in range(30)
    ]
    short = [short_seed(number) for number in numbers]
    assert len({*short}) == len({*numbers}) == len(numbers)
    assert max(short) < 2**32
    assert [short_seed(number) for number in (0, 2**32 - 1)] == [0, 2**32 - 1]
    task = made(line())
    task.reset(seed=max(numbers))
    task.close()


@pytest.mark.parametrize("camera", [-1, 0], ids=["free", "unnamed"])
@pytest.mark.parametrize("anew", ["data", "model"])
def test_model_and_data_may_be_made_anew_in_each_reset(anew: str, camera: int) -> None:
    """Frames, parts and places are those of the episode, whichever came before."""
    name = gym_examples.register(f"Ball{anew}{camera}-v0", gym_examples.Ball, anew=anew, camera=camera)
    task, frames, places, columns, reds = made(line(id=name, variation=VariationConfig(light=0.2))), [], [], [], []
    for seed in (1, 2, 1):
        observation, _ = task.reset(seed=seed)
        frames.append(observation["pixels"])
        places.append(task.places()["body1"][0])
        assert places[-1] == pytest.approx(observation[keys.STATE][0])
        ball = task.segment() == 1
        columns.append(np.nonzero(ball)[1].mean())
        red, _, blue = observation["pixels"][ball].mean(axis=0)
        reds.append(red / (red + blue))
    assert (columns[1] - columns[0]) / (places[1] - places[0]) > 10  # pixels a metre
    assert np.abs(frames[0].astype(int) - frames[1]).max() > 50
    assert bool((reds[1] - reds[0]) / (places[1] - places[0]) > 0.4) == (anew == "model")
    np.testing.assert_array_equal(frames[0], frames[2])
    task.close()


@pytest.mark.parametrize("camera", ["nan,1,1,0,0,0", "0,1,1,0,0,0", "1,inf,1,0,0,0", "1,2,3"])
def test_a_free_camera_is_six_finite_numbers(camera: str) -> None:
    name = gym_examples.register("Ball-v0", gym_examples.Ball)
    with pytest.raises(ConfigError, match=rf"got '{camera}', expected distance,.* \(finite, distance above 0\)"):
        check_task(line(id=name, camera=camera))


def test_an_expert_may_act_in_a_box_that_leaves_one_number_no_choice() -> None:
    space = gym.spaces.Box(np.array([-2, 1], np.float32), np.array([4, 1], np.float32))
    config = line(id=gym_examples.register("LineNarrow-v0", space=space), action_dim=2, expert="gym_examples:of_two")
    task = made(config)
    task.reset(seed=0)
    action = task.expert_action()
    np.testing.assert_array_equal(action, [0, 0])
    task.step(action)
    np.testing.assert_array_equal(task.inner.unwrapped.taken, [1, 1])  # type: ignore[attr-defined]
    task.close()
    off = gym.spaces.Box(np.array([-2, 0], np.float32), np.array([4, 0], np.float32))
    with pytest.raises(ConfigError, match="expected it in Box"):
        check_task(replace(config, id=gym_examples.register("LineNarrowOff-v0", space=off)), expert=True)


@pytest.mark.parametrize(
    ("observation", "numbers"),
    [
        ((np.zeros(2), [np.ones(3), 1.0]), 6),
        ({"place": [0.5], "mission": "go there"}, 1),
        (np.zeros((4, 4)), 16),
        (np.zeros(128, np.uint8), 128),
        ({"grey": np.ones((8, 8), np.uint8), "colours": np.ones((8, 8, 3), np.float32), "place": np.ones(2)}, 2),
    ],
)
def test_an_observation_is_its_numbers(observation: Any, numbers: int) -> None:
    assert flat(observation).shape == (numbers,)


@pytest.mark.parametrize("channels", [1, 4])
def test_grey_and_transparent_pictures_are_frames(channels: int) -> None:
    picture = np.full((40, 40, channels), 7, np.uint8)
    task = made(line(id=gym_examples.register(f"Line{channels}-v0", picture=picture)))
    np.testing.assert_array_equal(task.reset(seed=0)[0]["pixels"], np.full((32, 32, 3), 7))
    task.close()


def test_who_draws_no_squares_is_warned() -> None:
    with pytest.warns(RuntimeWarning, match="got pictures of 40 x 20 pixels, expected square ones"):
        facts(gym_examples.register("LineWide-v0"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        facts(gym_examples.register("LineSquare-v0", picture=np.zeros((30, 40, 3), np.uint8)))


def test_its_keys_are_its_own() -> None:
    with pytest.raises(ConfigError, match=r"env\.id: got 'FetchReach-v4', expected none with env=button_press"):
        compose(["env.id=FetchReach-v4"])
