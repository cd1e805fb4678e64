"""Playing without a browser: steps, time travel, touches, the simulator beside, other drivers."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from playslot_rl import keys
from playslot_rl.errors import CheckpointError
from playslot_rl.play import timeline as timeline_module
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import RecordedStarts, SimulatedStarts, Start
from playslot_rl.play.steering import variability_directions
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent, WorldModel


def same(a: Any, b: Any) -> bool:
    """Whether two states have the same bits."""
    return all(torch.equal(a[key], b[key]) for key in (keys.SLOTS, keys.SLOT_HISTORY, keys.ACTION_HISTORY))


def test_a_step_is_the_world_models(session: PlaySession, agent: Agent) -> None:
    model, start = agent.world_model, session.slots
    latents = [session.latent(2, 0.5), session.latent(4, -1.0)]
    for latent in latents:
        session.step(latent)
    p, v = model.inverse_dynamics.split(torch.stack(latents)[None])
    expected = model.predictor.rollout(start[None, None], p, v)[0, -1]
    torch.testing.assert_close(session.slots, expected, rtol=0, atol=2e-6)
    assert session.now.depth == 2
    assert session.now.label == "latent action"
    assert session.press(4, -1.0).label == "prototype 4 -1.0"


def test_the_same_presses_give_the_same_bits(agent: Agent, recorded: RecordedStarts) -> None:
    ends = []
    for _ in range(2):
        session = PlaySession(agent.world_model, agent)
        session.begin(recorded.start(0, 2))
        for number in (1, 1, 3, 0):
            session.press(number, 0.7)
        session.drive("policy")
        ends.append((session.slots, session.now.frame, session.now.true))
    assert torch.equal(ends[0][0], ends[1][0])
    assert np.array_equal(ends[0][1], ends[1][1])
    assert np.array_equal(ends[0][2], ends[1][2])


def test_undo_restores_every_bit_and_another_step_makes_a_branch(session: PlaySession) -> None:
    session.press(1)
    before = session.now
    state, frame = before.state.clone(), session.look().frame.copy()
    first = session.press(2)
    assert session.undo()
    assert session.now is before
    assert same(session.now.state, state)
    assert np.array_equal(session.look().frame, frame)
    again = session.press(2)
    assert same(again.state, first.state)
    assert again.number != first.number
    assert [moment.number for moment in session.timeline.tips()] == [first.number, again.number]
    session.go(first.number)
    assert same(session.now.state, first.state)
    session.reset()
    assert session.now.number == 0
    assert not session.undo()


def test_a_branch_shows_what_is_true_on_it(session: PlaySession) -> None:
    for number in (0, 1, 2):
        session.press(number)
    there = session.now
    session.go(1)
    session.press(4)
    assert session.now.error is not None
    session.go(2)  # back on the first branch: the simulator has to run it again
    after = session.press(2)
    assert np.array_equal(after.true, there.true)  # type: ignore[arg-type]
    assert after.error == there.error


def test_the_simulator_starts_where_the_recorded_frame_is(recorded: RecordedStarts) -> None:
    start = recorded.start(2, 4)
    assert start.twin is not None
    assert np.array_equal(start.twin.first, start.frame)
    assert recorded.start(2, 0).twin is not None


def test_another_scene_than_the_recorded_one_has_no_simulator_beside(agent: Agent, recorded: RecordedStarts) -> None:
    assert recorded.source.seeds is not None
    source = replace(recorded.source, seeds=recorded.source.seeds + 50)
    assert RecordedStarts(agent.world_model, source, recorded.make_task).start(0, 3).twin is None


def test_a_frozen_slot_stays_while_the_others_move(session: PlaySession) -> None:
    held = session.slots[2]
    session.freeze(2)
    for _ in range(3):
        session.press(1, 2.0)
        assert torch.equal(session.slots[2], held)
        assert torch.equal(session.now.state[keys.SLOT_HISTORY][0, -1, 2], held)
    assert not torch.equal(session.slots[0], session.timeline.moments[0].state[keys.SLOTS][0, 0])
    session.freeze(2, False)
    session.press(1, 2.0)
    assert not torch.equal(session.slots[2], held)


def test_a_removed_slot_is_gone_and_undo_brings_it_back(session: PlaySession, agent: Agent) -> None:
    slots = session.slots
    session.remove(1)
    assert session.now.present == (0, 2, 3)
    assert torch.equal(session.slots, slots[[0, 2, 3]])
    assert 1 not in session.look().owner
    session.press(0)
    session.drive("policy")
    model, alone = agent.world_model, PlaySession(agent.world_model)
    p, v = model.inverse_dynamics.split(session.latent(0)[None, None])
    alone_after = model.predictor.rollout(slots[None, None, [0, 2, 3]], p, v)[0, -1]
    torch.testing.assert_close(session.timeline.moments[2].state[keys.SLOTS][0], alone_after, rtol=0, atol=2e-6)
    assert alone.drivers == {}
    with pytest.raises(ValueError, match="slot: got 1, expected one that is there: 0, 2, 3"):
        session.freeze(1)
    for _ in range(3):
        session.undo()
    assert torch.equal(session.slots, slots)


def test_the_last_slot_cannot_be_removed(session: PlaySession) -> None:
    for slot in (0, 1, 2):
        session.remove(slot)
    with pytest.raises(ValueError, match="got the last slot"):
        session.remove(3)


def test_a_swapped_slot_comes_from_elsewhere_and_the_past_is_forgotten(session: PlaySession) -> None:
    session.press(0)
    before, other = session.slots, torch.randn(32, generator=torch.Generator().manual_seed(1))
    session.swap(3, other)
    assert torch.equal(session.slots[3], other)
    assert torch.equal(session.slots[:3], before[:3])
    assert int(session.now.state[keys.HISTORY_LENGTH]) == 1
    with pytest.raises(ValueError, match="swap: got a slot of shape"):
        session.swap(3, other[:5])


def test_actions_are_decoded_into_the_robots_units(agent: Agent, recorded: RecordedStarts) -> None:
    robots = deepcopy(agent)
    robots.action_decoder.action_range.take(
        torch.tensor([-90.0, 7.3, 0.0, -1.0]), torch.tensor([90.0, 7.3, 100.0, 1.0])
    )
    played, plain = PlaySession(robots.world_model, robots), PlaySession(agent.world_model, agent)
    played.begin(recorded.start(1, 3))
    plain.begin(recorded.start(1, 3))
    real, unit = played.press(2).action, plain.press(2).action
    assert real is not None
    assert unit is not None
    assert np.allclose(real, [90 * unit[0], 7.3, 50 * unit[2] + 50, unit[3]], atol=1e-5)
    assert real[1] == np.float32(7.3)


def test_actions_go_to_one_slot_where_each_has_its_own(many: WorldModel) -> None:
    session = PlaySession(many)
    assert session.per_slot
    start = torch.randn(1, 4, 32, generator=torch.Generator().manual_seed(0))
    session.begin(start_of(start))
    latent = session.latent(1, 0.5, slot=2)
    assert latent.shape == (4, 8)
    assert [bool(row.any()) for row in latent] == [False, False, True, False]
    session.press(1, 0.5, slot=2)
    assert session.now.label == "prototype 1 +0.5, slot 3"
    assert session.now.code is not None
    assert session.now.code.shape == (4,)
    assert session.now.action is None
    session.remove(0)
    session.press(1, 0.5, slot=2)
    assert session.slots.shape == (3, 32)
    assert session.preview([0, 1], slot=3).shape == (2, 7, 64, 64, 3)
    with pytest.raises(ValueError, match="slot: got 0"):
        session.press(1, slot=0)


def test_previews_are_what_the_presses_would_do(session: PlaySession) -> None:
    session.press(3)
    session.freeze(0)
    here = session.now
    frames = session.preview(variability=0.5, steps=3)
    assert session.now is here
    assert frames.shape == (5, 4, 64, 64, 3)
    for _ in range(3):
        session.press(2, 0.5)
    difference = np.abs(frames[2, -1].astype(int) - session.now.frame)
    assert difference.max() <= 1
    assert np.array_equal(session.preview([2, 4])[:, 0], np.stack([session.now.frame] * 2))


@pytest.mark.integration
def test_the_planner_steers_to_the_moment_that_is_marked(session: PlaySession) -> None:
    assert session.planner is not None
    with pytest.raises(ValueError, match="goal: got none, expected a marked moment"):
        session.drive("planner")
    start = session.slots
    for number in (2, 2, 4):
        session.press(number)
    goal = session.slots
    session.planner.aim(session)
    session.reset()
    for _ in range(6):
        session.drive("planner")
    assert session.now.label == "planner"
    mean = session.world_model.inverse_dynamics.scene_dynamics
    far, near = ((mean(slots)[0] - mean(goal)[0]).square().mean() for slots in (start, session.slots))
    assert float(near) < float(far)
    session.remove(0)
    with pytest.raises(ValueError, match=r"planner: got \d slots, expected all"):
        session.drive("planner")


def test_a_planner_may_take_over_by_one_method(session: PlaySession) -> None:
    class Still:
        title = "still"

        def choose(self, session: PlaySession) -> Tensor:
            return torch.zeros(session.world_model.latent_shape)

    session.drivers["still"] = Still()
    assert session.drive("still").label == "still"
    with pytest.raises(ValueError, match="driver: got 'nobody', expected one of policy, planner, still"):
        session.drive("nobody")


def test_directions_are_one_standard_deviation_of_what_the_videos_vary_by(
    agent: Agent, recorded: RecordedStarts, simulated: SimulatedStarts
) -> None:
    model = agent.world_model
    for clips in (recorded.clips(), simulated.clips(), None):
        directions = variability_directions(model, clips)
        assert directions.shape == (5, 8)
        assert bool((directions.norm(dim=1) > 0).all())
        assert torch.equal(directions, variability_directions(model, clips))
    clips = recorded.clips()
    assert clips is not None
    with torch.no_grad():
        slots, _ = model.savi(torch.from_numpy(clips).movedim(-1, -3).float() / 255)
        latents = model.inverse_dynamics(slots)
    difference = (latents.z - latents.prototype).flatten(0, 1)
    direction = variability_directions(model, clips)[0]
    along = (difference - difference.mean(0)) @ (direction / direction.norm())
    few = int((latents.code == 0).sum()) < 8
    assert not few or float(along.std()) == pytest.approx(float(direction.norm()), rel=1e-3)


def test_a_model_without_prototypes_is_refused() -> None:
    with pytest.raises(CheckpointError, match="latent-action mode continuous, expected hybrid or discrete"):
        PlaySession(tiny_agent(tiny_config("continuous")).world_model)


def test_wrong_presses_are_refused(session: PlaySession, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="prototype: got 5, expected 0 to 4"):
        session.press(5)
    with pytest.raises(ValueError, match="step: got a latent of"):
        session.step(torch.zeros(3))
    with pytest.raises(ValueError, match="timeline: got moment 9, expected 0 to 0"):
        session.go(9)
    monkeypatch.setattr(timeline_module, "MOST", 2)
    session.press(0)
    with pytest.raises(ValueError, match="got a full timeline"):
        session.press(0)
    assert len(session.timeline.moments) == 2


def start_of(slots: Tensor) -> Start:
    """A start that nobody saw."""
    return Start("slots", np.zeros((64, 64, 3), np.uint8), slots)
