"""The TorchRL form of ButtonPress."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.envs import block_ids, make_env, make_torchrl_env
from playslot_rl.envs.lerobot import LeRobotTask

SMALL = EnvConfig(image_size=32, warmup_steps=1, max_steps=3)


def test_specs_match_what_it_returns() -> None:
    from torchrl.envs.utils import check_env_specs

    env = make_torchrl_env(SMALL)
    check_env_specs(env)
    rollout = env.rollout(10)
    assert rollout.batch_size == (3,)
    assert rollout[keys.PIXELS].shape == (3, 3, 32, 32)
    assert rollout[keys.PIXELS].dtype == torch.uint8
    assert rollout[keys.STATE].shape == (3, 4)
    assert rollout["next", keys.SUCCESS].dtype == torch.bool
    assert rollout["next", "truncated"].flatten().tolist() == [False, False, True]
    env.close()


def test_set_seed_starts_that_episode() -> None:
    env, gym_env = make_torchrl_env(SMALL), make_env(SMALL)
    expected = torch.from_numpy(gym_env.reset(seed=7)[0]["pixels"]).permute(2, 0, 1)
    env.set_seed(7)
    first = env.rollout(10)
    second = env.rollout(10)
    assert torch.equal(first[keys.PIXELS][0], expected)
    assert not torch.equal(second[keys.PIXELS][0], expected)
    env.close()
    gym_env.close()


@pytest.mark.integration
def test_proprioception_has_one_name() -> None:
    """In Gymnasium's observations, in TorchRL's own wrapper and in ours; LeRobot's programs have LeRobot's."""
    from torchrl.envs import GymEnv

    name, config = "PlaySlot/BlockPushEasy-v0", block_ids()["PlaySlot/BlockPushEasy-v0"][1]
    task, wrapped, ours, lerobot = make_env(config), GymEnv(name), make_torchrl_env(config), LeRobotTask(config)
    observation, _ = task.reset(seed=4)
    assert set(observation) == set(task.observation_space.spaces) == {keys.PIXELS, keys.STATE}
    assert set(wrapped.observation_spec.keys()) == set(observation)
    assert set(ours.observation_spec.keys()) == {*observation, keys.SUCCESS}
    ours.set_seed(4)
    assert torch.equal(ours.reset()[keys.STATE], torch.from_numpy(observation[keys.STATE]))
    np.testing.assert_array_equal(lerobot.reset(seed=4)[0]["agent_pos"], observation[keys.STATE])
    for env in (task, wrapped, ours, lerobot):
        env.close()


def test_its_older_name_still_reads_it() -> None:
    task = make_env(SMALL)
    observation, _ = task.reset(seed=4)
    with pytest.warns(DeprecationWarning, match=f'is called "{keys.STATE}"'):
        assert observation["state"] is observation[keys.STATE]
    with pytest.raises(KeyError, match="stat"):
        observation["stat"]
    assert "state" not in observation
    task.close()
