"""Starts from pictures and data sets, and what is refused."""

from __future__ import annotations

import io
import time
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from scene import DotTask, make_source

from playslot_rl.data.source import EpisodeFrames
from playslot_rl.errors import DataError
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import RecordedStarts, SimulatedStarts, picture_start
from playslot_rl.play.studio import Studio
from playslot_rl.world_model import Agent


def picture(height: int, width: int, kind: str = "PNG") -> bytes:
    """A picture file: red on the left, blue on the right, white in the middle square."""
    pixels = np.full((height, width, 3), 255, np.uint8)
    buffer = io.BytesIO()
    pixels[:, : (width - height) // 2], pixels[:, width - (width - height) // 2 :] = (255, 0, 0), (0, 0, 255)
    Image.fromarray(pixels).save(buffer, format=kind)
    return buffer.getvalue()


def test_a_picture_of_any_size_is_cut_to_its_middle_square_and_resized(agent: Agent) -> None:
    start = picture_start(agent.world_model, picture(120, 200))
    assert start.frame.shape == (64, 64, 3)
    assert int(start.frame.min()) == 255
    assert start.slots.shape == (1, 4, 32)
    assert start.twin is None
    same = picture_start(agent.world_model, picture(64, 64))
    parsed, _ = agent.world_model.savi(torch.ones(1, 1, 3, 64, 64))
    torch.testing.assert_close(same.slots, parsed[:, 0])


def test_a_picture_is_squeezed_where_the_models_frames_were(agent: Agent) -> None:
    frame = picture_start(agent.world_model, picture(120, 200), whole=True).frame
    assert frame.shape == (64, 64, 3)
    assert frame[30, 2].tolist() == [255, 0, 0]
    assert frame[30, -3].tolist() == [0, 0, 255]


@pytest.mark.parametrize("content", [b"", b"no picture at all", picture(64, 64)[:60]])
def test_what_is_no_picture_is_refused_in_one_line(agent: Agent, content: bytes) -> None:
    with pytest.raises(DataError, match=r"^cat\.png: got no picture that can be read, expected a PNG") as caught:
        picture_start(agent.world_model, content, "cat.png")
    assert "\n" not in str(caught.value)


def test_a_start_in_the_middle_is_parsed_from_the_episodes_first_frame(agent: Agent, recorded: RecordedStarts) -> None:
    frames = torch.from_numpy(np.asarray(recorded.source.frames[:4])).movedim(-1, -3).float() / 255
    slots, _ = agent.world_model.savi(frames[None])
    torch.testing.assert_close(recorded.start(0, 3).slots, slots[:, -1])


@pytest.mark.parametrize("place", [(3, 0), (0, 7), (-1, 0)])
def test_a_frame_that_is_not_there_is_refused(recorded: RecordedStarts, place: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=f"got frame {place[1]} of episode {place[0]}"):
        recorded.start(*place)


def test_episodes_of_one_frame_can_be_started_from(agent: Agent) -> None:
    starts = RecordedStarts(agent.world_model, make_source(frames=1), DotTask)
    assert starts.clips() is None
    session = PlaySession(agent.world_model, agent)
    session.begin(starts.start(2, 0))
    session.press(1)
    assert session.now.true is not None


def test_a_data_set_without_seeds_or_fitting_actions_has_no_simulator_beside(
    agent: Agent, source: EpisodeFrames
) -> None:
    assert source.actions is not None
    for other in (
        replace(source, seeds=None),
        replace(source, actions=None),
        replace(source, actions=source.actions[:, :2]),
    ):
        assert RecordedStarts(agent.world_model, other, DotTask).start(0, 2).twin is None


def test_simulators_are_closed_with_their_starts(agent: Agent, simulated: SimulatedStarts) -> None:
    before = DotTask.open_tasks
    session = PlaySession(agent.world_model, agent)
    session.begin(simulated.start(0))
    session.begin(simulated.start(1))
    assert DotTask.open_tasks == before + 1
    session.close()
    assert DotTask.open_tasks == before


def test_a_page_that_closes_while_the_worker_is_busy_frees_its_simulator(studio: Studio) -> None:
    before, session = DotTask.open_tasks, studio.session()
    studio.call(lambda: session.begin(studio.start("simulated"))).result()
    studio.call(lambda: time.sleep(0.2))
    studio.call(session.close)
    studio.close()
    assert DotTask.open_tasks == before
