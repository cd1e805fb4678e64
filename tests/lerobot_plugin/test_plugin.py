"""The second distribution: LeRobot finds policy and tasks, and gets from them what it expects."""

from __future__ import annotations

import importlib.metadata
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch

from playslot_rl.acting.agent import playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import EnvConfig
from playslot_rl.envs import task_config, task_env

# The evaluation's imports first: MuJoCo has to find its GL backend before LeRobot imports anything that imports it.
from playslot_rl.envs.lerobot import LeRobotTask, frames_a_second
from playslot_rl.errors import CheckpointError, ConfigError
from playslot_rl.sharing.folder import FILES, SharedPolicyConfig, save_pretrained
from playslot_rl.storage.atomic import write_json
from playslot_rl.testing import tiny_agent, tiny_config

SEED = 1_000_000_000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An untrained agent's model folder."""
    agent = tiny_agent()
    config = SharedPolicyConfig(env=agent.world_model.env, model=agent.world_model.config, source={"demos": 3})
    save_pretrained(agent, tmp_path_factory.mktemp("shared") / "policy", config, lambda _: "card\n")
    return next(tmp_path_factory.getbasetemp().glob("shared*/policy"))


@pytest.fixture(scope="module")
def loaded(folder: Path) -> tuple[Any, Any, Any]:
    """Policy and processors as `lerobot-eval` makes them."""
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies import make_policy, make_pre_post_processors

    import lerobot_policy_playslot

    config = PreTrainedConfig.from_pretrained(folder)
    config.pretrained_path = folder
    policy = make_policy(config, env_cfg=lerobot_policy_playslot.PlaySlotEnv())
    overrides = {"device_processor": {"device": "cpu"}, "rename_observations_processor": {"rename_map": {}}}
    before, after = make_pre_post_processors(config, str(folder), preprocessor_overrides=overrides)
    return policy, before, after


@pytest.fixture(scope="module")
def task() -> Iterator[LeRobotTask]:
    """ButtonPress as LeRobot sees it."""
    env = LeRobotTask(EnvConfig())
    yield env
    env.close()


def test_lerobot_finds_the_distribution_by_its_name() -> None:
    names = {dist.metadata["Name"] for dist in importlib.metadata.distributions()}
    assert "lerobot_policy_playslot" in names, "run `make setup`"


def test_policy_and_tasks_are_registered() -> None:
    from lerobot.configs import PreTrainedConfig
    from lerobot.envs import EnvConfig as LeRobotEnvConfig
    from lerobot.policies.factory import get_policy_class

    import lerobot_policy_playslot as plugin

    assert PreTrainedConfig.get_choice_class("playslot") is plugin.PlaySlotConfig
    assert LeRobotEnvConfig.get_choice_class("playslot") is plugin.PlaySlotEnv
    assert get_policy_class("playslot").__name__ == "PlaySlotPolicy"


def test_the_config_survives_lerobots_own_saving(folder: Path, tmp_path: Path) -> None:
    from lerobot.configs import PreTrainedConfig

    import lerobot_policy_playslot  # noqa: F401

    config = PreTrainedConfig.from_pretrained(folder)
    config.save_pretrained(tmp_path)
    again = PreTrainedConfig.from_pretrained(tmp_path)
    assert again == config
    assert again.policy_config() == config.policy_config()
    assert config.policy_config().source == {"demos": 3}
    assert config.type == "playslot"


def test_a_policy_saved_by_lerobot_is_the_same_folder(
    folder: Path, loaded: tuple[Any, Any, Any], tmp_path: Path
) -> None:
    from playslot_rl.sharing.folder import load_pretrained

    policy, before, after = loaded
    policy.save_pretrained(tmp_path)
    before.save_pretrained(tmp_path, config_filename="policy_preprocessor.json")
    after.save_pretrained(tmp_path, config_filename="policy_postprocessor.json")
    same = [name for name in FILES if name not in ("README.md", "config.json")]
    assert all((tmp_path / name).read_bytes() == (folder / name).read_bytes() for name in same)
    assert load_pretrained(tmp_path)[1] == load_pretrained(folder)[1]


def test_fresh_processors_are_those_of_the_folder(folder: Path, loaded: tuple[Any, Any, Any]) -> None:
    from lerobot.policies import make_pre_post_processors

    fresh = make_pre_post_processors(loaded[0].config)
    assert [pipeline.get_config() for pipeline in fresh] == [pipeline.get_config() for pipeline in loaded[1:]]


def test_select_action_is_the_closed_loop_of_the_evaluation(loaded: tuple[Any, Any, Any]) -> None:
    from lerobot.envs import preprocess_observation

    policy, before, after = loaded
    loop = ClosedLoop(playslot_actor(tiny_agent()))
    frames = np.random.default_rng(0).integers(256, size=(3, 2, 64, 64, 3), dtype=np.uint8)
    policy.reset()
    for batch in frames:
        observation = preprocess_observation({"pixels": {"front": batch}, "agent_pos": np.zeros((2, 4), np.float32)})
        actions = after(policy.select_action(before({**observation, "task": ["", ""]})))
        assert actions.shape == (2, 4)
        torch.testing.assert_close(actions, loop.act(torch.from_numpy(batch).movedim(-1, 1)), rtol=0, atol=1e-6)


def test_reset_forgets_the_episode(loaded: tuple[Any, Any, Any]) -> None:
    policy = loaded[0]
    batch = {"observation.images.front": torch.rand(1, 3, 64, 64, generator=torch.Generator().manual_seed(1))}
    policy.reset()
    first, later = policy.select_action(batch), policy.select_action(batch)
    assert not torch.equal(first, later)
    policy.reset()
    policy.train()  # as while it is trained; it acts in evaluation mode nevertheless
    assert torch.equal(policy.predict_action_chunk(batch), first[:, None])
    assert not any(module.training for module in policy.modules())
    policy.reset()
    assert torch.equal(policy.select_action({"front": next(iter(batch.values()))}), first), "renamed to the short name"
    policy.reset()


TWO = "metaworld/reach+drawer-open"


def test_a_policy_of_several_tasks_does_what_lerobot_says(tmp_path: Path) -> None:
    from lerobot_policy_playslot.modeling_playslot import PlaySlotPolicy

    agent = tiny_agent(replace(tiny_config(), env=task_config(TWO)))
    env = agent.world_model.env
    config = SharedPolicyConfig(env=env, model=agent.world_model.config)
    save_pretrained(agent, tmp_path / "policy", config, lambda _: "card\n")
    policy, ours = PlaySlotPolicy.from_pretrained(tmp_path / "policy"), ClosedLoop(playslot_actor(agent))
    frames = torch.rand(1, 3, 64, 64).expand(2, -1, -1, -1)
    ours.reset([0, 1])
    expected = ours.act(frames)
    assert (expected[0] - expected[1]).abs().max() > 1e-5
    for said, tasks in (([*env.sentences], [0, 1]), (env.sentences[1], [1, 1]), (["reach"], [0, 0])):
        policy.reset()
        acted = policy.select_action({"observation.images.front": frames, "task": said})
        torch.testing.assert_close(acted, expected[tasks], rtol=0, atol=1e-6)
    for batch in ({}, {"task": ["", ""]}):
        policy.reset()
        with pytest.raises(ValueError, match=r"task: got '', expected one of 2: reach, drawer-open"):
            policy.select_action({"observation.images.front": frames, **batch})


@pytest.mark.integration
def test_an_environment_of_several_tasks_says_what_to_do() -> None:
    env = LeRobotTask(task_config(TWO))
    try:
        for seed in (SEED, SEED + 1, SEED):
            env.reset(seed=seed)
            assert env.get_wrapper_attr("task_description") == task_config(TWO).sentences[seed % 2]
    finally:
        env.close()


def test_what_does_not_fit_is_refused(folder: Path, loaded: tuple[Any, Any, Any]) -> None:
    from lerobot_policy_playslot import PlaySlotConfig

    policy = loaded[0]
    with pytest.raises(ValueError, match=r"got observation.images.top, expected observation.images.front"):
        policy.select_action({"observation.images.top": torch.zeros(1, 3, 64, 64)})
    for frames in (torch.full((1, 3, 64, 64), 255.0), torch.full((1, 3, 64, 64), float("nan"))):
        with pytest.raises(ValueError, match=r"observation.images.front: got floats in .* expected \[0, 1\]"):
            policy.select_action({"observation.images.front": frames})
    for frames in (torch.full((1, 3, 64, 64), 255), np.zeros((1, 3, 64, 64), np.float32)):
        with pytest.raises(ValueError, match=r"front: got .*(int64|float32), expected a tensor of floats in"):
            policy.select_action({"observation.images.front": frames})
    for refuse in (lambda: policy.forward({}), policy.get_optim_params, policy.config.get_optimizer_preset):
        with pytest.raises(NotImplementedError, match="playslot train-policy"):
            refuse()
    with pytest.raises(ValueError, match=r"unknown key env\.wings"):
        PlaySlotConfig(env={"wings": 2})
    with pytest.raises(ValueError, match=r"expected \[3, 32, 32\]"):
        PlaySlotConfig(env={"image_size": 32}, input_features=policy.config.input_features)


def test_lerobots_loading_is_strict(folder: Path, tmp_path: Path) -> None:
    import shutil

    from lerobot.policies.factory import get_policy_class

    import lerobot_policy_playslot  # noqa: F401

    broken = Path(shutil.copytree(folder, tmp_path / "broken"))
    weights = broken / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:-1] + b"\x7f")
    with pytest.raises(CheckpointError, match="got fingerprint"):
        get_policy_class("playslot").from_pretrained(broken)


def test_lerobot_refuses_a_robots_policy_of_an_earlier_version(folder: Path, tmp_path: Path) -> None:
    import shutil

    from lerobot.policies.factory import get_policy_class

    import lerobot_policy_playslot  # noqa: F401

    old = Path(shutil.copytree(folder, tmp_path / "old"))
    values = json.loads((old / "config.json").read_text())
    values["env"]["name"] = "video"
    for actions in ({"actions": {}}, {}):
        write_json(old / "config.json", values | actions)
        if actions:
            assert get_policy_class("playslot").from_pretrained(old).config.actions == {}
        else:
            with pytest.raises(ValueError, match=r"clips the robot's actions to \[-1, 1\]: train it again"):
                get_policy_class("playslot").from_pretrained(old)


def test_a_task_looks_as_lerobot_expects(task: LeRobotTask) -> None:
    observation, info = task.reset(seed=SEED)
    assert task.observation_space.contains(observation)
    assert observation["pixels"]["front"].shape == (64, 64, 3)
    assert info == {"is_success": False}
    assert task.get_wrapper_attr("_max_episode_steps") == 20
    assert task.get_wrapper_attr("task_description") == "Press the red button."
    assert task.get_wrapper_attr("task") == "button_press"
    assert task.metadata["render_fps"] == frames_a_second(EnvConfig()) == 16
    assert np.array_equal(task.render(), observation["pixels"]["front"])


@pytest.mark.integration
def test_an_episode_ends_at_its_success_and_not_before(task: LeRobotTask) -> None:
    task.reset(seed=SEED)
    steps = 0
    terminated = False
    while not terminated and steps < 20:
        steps += 1
        _, reward, terminated, _, info = task.step(task_env(task).expert_action())
        assert isinstance(reward, float)
        assert terminated == info["is_success"]
    assert info["is_success"], "the expert presses the button"
    assert 5 < steps < 20, "neither at once nor at the limit"
    task.reset(seed=SEED)
    ends = [task.step(np.zeros(4, np.float32))[2:4] for _ in range(20)]
    assert ends == [(False, False)] * 19 + [(False, True)]


@pytest.mark.integration
def test_environments_side_by_side_wait_for_each_other() -> None:
    from lerobot.envs.utils import NEW_ROLLOUT_OPTION

    from lerobot_policy_playslot import PlaySlotEnv

    made = PlaySlotEnv(episode_length=3).create_envs(2)
    env = made["button_press"][0]
    try:
        assert isinstance(env, gym.vector.SyncVectorEnv)
        env.reset(seed=[SEED, SEED + 1], options={NEW_ROLLOUT_OPTION: True})
        for step in range(5):
            observation, reward, _, truncated, info = env.step(np.zeros((2, 4), np.float32))
            assert truncated.tolist() == [step >= 2] * 2
            assert ("final_info" in info) == (step >= 2)
            assert (reward == 0).all() == (step > 2), "an episode that is over earns nothing"
        first, _ = env.reset(seed=[SEED, SEED + 1], options={NEW_ROLLOUT_OPTION: True})
        assert not np.array_equal(first["pixels"]["front"], observation["pixels"]["front"])
    finally:
        env.close()


@pytest.mark.parametrize("task", ["block_push_easy", "block_push"])
def test_other_tasks_have_their_own_settings(task: str) -> None:
    from lerobot_policy_playslot import PlaySlotEnv
    from playslot_rl.config.compose import compose

    config = PlaySlotEnv(task=task)
    assert config.task_config() == compose([f"env={task}"]).env
    assert config.features["agent_pos"].shape == (4,)
    assert PlaySlotEnv(task=task, episode_length=7).task_config() == replace(config.task_config(), max_steps=7)
    for key in ("episode_length", "frame_skip"):
        with pytest.raises(ValueError, match="got 0, expected"):
            PlaySlotEnv(task=task, **{key: 0})


def test_the_state_is_as_wide_as_the_tasks() -> None:
    pytest.importorskip("ogbench")
    from lerobot_policy_playslot import PlaySlotEnv

    config = PlaySlotEnv(task="ogbench/cube-single")
    assert (config.features["action"].shape, config.features["agent_pos"].shape) == ((5,), (5,))


@pytest.mark.parametrize("task", ["grid_shapes", "button_pres"])
def test_a_task_that_cannot_be_simulated_is_refused(task: str) -> None:
    from lerobot_policy_playslot import PlaySlotEnv

    with pytest.raises(ConfigError, match=task):
        PlaySlotEnv(task=task)
