"""The TorchRL form of ButtonPress."""

from __future__ import annotations

import torch

from playslot_rl import keys
from playslot_rl.config import EnvConfig
from playslot_rl.envs import make_env, make_torchrl_env

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
