"""Acting one call a step: it remembers its episodes, forgets when told to, and refuses what does not fit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from playslot_rl.acting.agent import playslot_actor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.data.frames import resize_frames
from playslot_rl.testing import tiny_agent
from playslot_rl.world_model import Agent

FRAMES = np.random.default_rng(0).integers(256, size=(4, 2, 64, 64, 3), dtype=np.uint8)  # (T, B, H, W, 3)


@pytest.fixture(scope="module")
def agent() -> Agent:
    return tiny_agent()


def closed_loop(agent: Agent, resize: bool = False) -> ClosedLoop:
    return ClosedLoop(playslot_actor(agent), image_size=64, resize=resize)


def as_lerobot(frames: np.ndarray) -> torch.Tensor:
    """What `lerobot.envs.preprocess_observation` makes of a batch of frames."""
    return torch.from_numpy(frames).permute(0, 3, 1, 2).contiguous().float() / 255


def test_bytes_and_floats_give_the_same_actions(agent: Agent) -> None:
    floats, integers = closed_loop(agent), closed_loop(agent)
    for frames in FRAMES[:2]:
        chw = torch.from_numpy(frames).permute(0, 3, 1, 2)
        torch.testing.assert_close(integers.act(chw), floats.act(as_lerobot(frames)), rtol=0, atol=1e-6)


def test_it_remembers_until_it_is_reset(agent: Agent) -> None:
    policy = closed_loop(agent)
    first, same = as_lerobot(FRAMES[0]), as_lerobot(FRAMES[0])
    fresh = policy.act(first)
    later = policy.act(same)
    assert not torch.equal(fresh, later), "the second look at a frame starts from the first one's slots"
    policy.reset()
    assert torch.equal(policy.act(first), fresh)


def test_the_episodes_of_a_batch_do_not_touch_each_other(agent: Agent) -> None:
    both, one = closed_loop(agent), closed_loop(agent)
    for frames in FRAMES:
        batch = as_lerobot(frames)
        torch.testing.assert_close(both.act(batch)[1:], one.act(batch[1:]), rtol=0, atol=1e-5)


def test_frames_of_another_size_are_resized_as_in_training_or_refused(agent: Agent) -> None:
    large = np.random.default_rng(1).integers(256, size=(1, 128, 128, 3), dtype=np.uint8)
    with pytest.raises(ValueError, match="frames of 128x128, expected 64x64"):
        closed_loop(agent).act(as_lerobot(large))
    expected = closed_loop(agent).act(as_lerobot(resize_frames(large, 64)))
    got = closed_loop(agent, resize=True).act(as_lerobot(large))
    torch.testing.assert_close(got, expected, rtol=0, atol=1e-6)


def test_other_shapes_and_a_changed_number_of_episodes_are_refused(agent: Agent) -> None:
    policy = closed_loop(agent)
    with pytest.raises(ValueError, match=r"got shape \(3, 64, 64\), expected \(batch, 3, 64, 64\)"):
        policy.act(torch.zeros(3, 64, 64))
    policy.act(as_lerobot(FRAMES[0]))
    with pytest.raises(ValueError, match=r"got 1 episodes, expected 2 .* call reset"):
        policy.act(as_lerobot(FRAMES[1][:1]))
