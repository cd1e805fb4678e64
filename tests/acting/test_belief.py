"""Acting on beliefs: between the paper's policy, which sees one frame, and imagination, which sees the first alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

from playslot_rl import keys
from playslot_rl.acting.actor import SlotActor
from playslot_rl.acting.agent import imagine, playslot_actor
from playslot_rl.acting.belief import BeliefActor
from playslot_rl.acting.closed_loop import ClosedLoop
from playslot_rl.config import BehaviourStageConfig
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent

CONTEXT, STEPS = 3, 6  # the window slides


def agent_of(gain: float) -> Agent:
    config = tiny_config(context=CONTEXT)
    return tiny_agent(replace(config, model=replace(config.model, policy=replace(config.model.policy, gain=gain))))


def videos(n: int = 2, seed: int = 0) -> Tensor:
    return torch.rand(n, STEPS, 3, 64, 64, generator=torch.Generator().manual_seed(seed))


def acted(actor: SlotActor, frames: Tensor) -> Tensor:
    loop = ClosedLoop(actor.eval())
    loop.reset(list(range(len(frames))))
    shown = frames.unbind(1)
    return torch.stack([loop.step(TensorDict({keys.PIXELS: x}, [len(x)]))[keys.ACTION] for x in shown], 1)


def test_a_gain_of_one_is_the_papers_policy() -> None:
    agent, frames = agent_of(1.0), videos()
    torch.testing.assert_close(acted(BeliefActor(agent), frames), acted(playslot_actor(agent), frames))
    assert not isinstance(playslot_actor(agent), BeliefActor)


def test_without_gain_only_the_first_frame_counts_as_in_imagination() -> None:
    agent, frames = agent_of(0.0), videos()
    imagined = imagine(agent, TensorDict({keys.PIXELS: frames[:, 0]}, [2]), STEPS).actions
    torch.testing.assert_close(acted(playslot_actor(agent), frames), imagined)
    other = torch.cat((frames[:, :1], videos(seed=1)[:, 1:]), 1)
    torch.testing.assert_close(acted(playslot_actor(agent), other), imagined)


def test_between_them_the_belief_is_between_prediction_and_frame() -> None:
    agent, frames = agent_of(0.25), videos(1)
    actor = playslot_actor(agent).eval()
    memory = actor.reset([0])
    with torch.no_grad():
        for step in range(2):
            memory = actor(memory.set(keys.PIXELS, frames[:, step]))
        parsed, first, second = memory[keys.SLOTS], *memory[keys.SLOT_HISTORY][:, -2:].unbind(1)
        z = memory[keys.ACTION_HISTORY][:, -2]
        predicted = agent.world_model._next_slots(first[:, None], z[:, None], None)
    assert memory[keys.HISTORY_LENGTH].tolist() == [[2]]
    torch.testing.assert_close(second, predicted + 0.25 * (parsed - predicted))


def test_episodes_side_by_side_do_not_touch_each_other() -> None:
    actor, frames = playslot_actor(agent_of(0.5)).eval(), videos(3)
    together = ClosedLoop(actor)
    together.reset([0, 1, 2])
    rows = [[0, 1, 2], [0, 2], [0, 1, 2], [1]]
    of_two = [
        together.step(TensorDict({keys.PIXELS: frames[some, step]}, [len(some)]), some)[keys.ACTION][some.index(2)]
        for step, some in enumerate(rows)
        if 2 in some
    ]
    torch.testing.assert_close(torch.stack(of_two), acted(actor, frames[2:])[0, :3])


def test_a_gain_is_between_nothing_and_one() -> None:
    with pytest.raises(ValueError, match=r"behaviour\.gain: got 1\.5, expected 0 to 1"):
        BehaviourStageConfig(gain=1.5)
