"""PlaySlot as an actor acts as the closed loop of the evaluation does; memories belong to their episodes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from playslot_rl import keys
from playslot_rl.acting.actor import ActorController
from playslot_rl.acting.controllers import ClosedLoop
from playslot_rl.acting.episodes import Controller, Moment
from playslot_rl.acting.slot_actor import SlotActor
from playslot_rl.baselines.playslot import playslot_actor
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent, oracle_module

CPU = torch.device("cpu")


def _agent(initial: str) -> Agent:
    config = tiny_config()
    savi = replace(config.model.savi, initial=initial)  # type: ignore[arg-type]
    return tiny_agent(replace(config, model=replace(config.model, savi=savi)))


def _play(controller: Controller, seeds: list[int], running: list[list[int]]) -> list[np.ndarray]:
    """Actions of episodes that end at different steps, on frames that depend on episode and step."""
    actions = []
    for step, rows in enumerate(running):
        frames = [np.random.default_rng([seeds[i], step]).integers(0, 256, (64, 64, 3), np.uint8) for i in rows]
        moment = Moment(step, rows, [seeds[i] for i in rows], np.stack(frames), [])
        if step == 0:
            controller.begin(moment)
        actions.append(controller.act(moment))
    return actions


RUNNING = [[0, 1, 2], [0, 1, 2], [0, 2], [2]]


@pytest.mark.parametrize("initial", ["learned", "gaussian"])
def test_playslot_as_an_actor_equals_the_closed_loop(initial: str) -> None:
    agent = _agent(initial)
    acted = _play(ActorController(playslot_actor(agent), CPU), [5, 6, 7], RUNNING)
    expected = _play(ClosedLoop(agent), [5, 6, 7], RUNNING)
    for ours, theirs in zip(acted, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_the_slot_oracle_as_an_actor_equals_the_reference() -> None:
    agent = _agent("learned")
    assert agent.oracle is not None
    actor = SlotActor(agent.world_model.savi, oracle_module(agent.oracle))
    acted = _play(ActorController(actor, CPU), [5, 6, 7], RUNNING)
    for ours, theirs in zip(acted, _play(ClosedLoop(agent, oracle=True), [5, 6, 7], RUNNING), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_an_actor_forgets_at_the_start_of_new_episodes() -> None:
    controller = ActorController(playslot_actor(_agent("gaussian")), CPU)
    first = _play(controller, [5, 6, 7], RUNNING)
    again = _play(controller, [5, 6, 7], RUNNING)
    for one, two in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, two)


def test_the_memory_is_what_the_module_reads_and_writes() -> None:
    actor = playslot_actor(_agent("learned"))
    memory = actor.initial([1, 2])
    assert set(memory.keys()) == {keys.SLOT_STATE, keys.SLOT_AGE}
    out = actor.module(memory.clone().set(keys.PIXELS, torch.zeros(2, 3, 64, 64, dtype=torch.uint8)))
    assert out[keys.ACTION].shape == (2, 4)
    assert out[keys.SLOT_AGE].flatten().tolist() == [1, 1]
    assert not torch.equal(out[keys.SLOT_STATE], memory[keys.SLOT_STATE])
