"""What stands beside the imagined scene where no simulator runs the episode again; the trained horizon; the camera."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("nicegui", reason="the extra `play` is not installed")

from nicegui.testing import User
from page_script import press, simulate, until
from scene import EPISODES, FRAMES

from playslot_rl import keys
from playslot_rl.config import ExperimentConfig
from playslot_rl.data.source import EpisodeFrames
from playslot_rl.data.views import every
from playslot_rl.play import pictures
from playslot_rl.play.page import PlayPage
from playslot_rl.play.recording import record
from playslot_rl.play.session import PlaySession
from playslot_rl.play.starts import RecordedStarts
from playslot_rl.play.studio import Studio
from playslot_rl.recipes import play
from playslot_rl.runs import Run, pretrained_folder
from playslot_rl.world_model import Agent

pytestmark = pytest.mark.integration


@pytest.fixture
def robots(agent: Agent, source: EpisodeFrames) -> RecordedStarts:
    """Episodes of a robot that nobody simulates."""
    return RecordedStarts(agent.world_model, replace(source, seeds=None, camera="observation.images.top"))


def test_the_recorded_frame_of_the_same_step_stands_beside(agent: Agent, robots: RecordedStarts) -> None:
    session = PlaySession(agent.world_model, agent)
    session.begin(robots.start(1, 2))
    recorded = np.asarray(robots.source.frames[robots.source.episode_rows(1)])
    assert np.array_equal(session.now.recorded, recorded[2])  # type: ignore[arg-type]
    session.press(1)
    session.freeze(0)  # takes no time
    assert session.now.steps == 1
    assert np.array_equal(session.now.recorded, recorded[3])  # type: ignore[arg-type]
    session.drive("policy")
    assert np.array_equal(session.now.recorded, recorded[4])  # type: ignore[arg-type]
    session.go(1)
    session.press(3)  # another branch, the same time
    assert np.array_equal(session.now.recorded, recorded[4])  # type: ignore[arg-type]
    assert session.now.true is None
    assert session.now.error is None, "it went on by other actions"
    for _ in range(2):
        session.press(0)
    assert np.array_equal(session.now.recorded, recorded[FRAMES - 1])  # type: ignore[arg-type]
    assert session.press(0).recorded is None, "the next row is of another episode"


def test_the_last_episode_ends_too_and_every_second_frame_is_every_second_step(
    agent: Agent, robots: RecordedStarts
) -> None:
    source = every(robots.source, 2)
    session = PlaySession(agent.world_model)
    session.begin(RecordedStarts(agent.world_model, source).start(EPISODES - 1, 2))
    session.press(0)
    assert np.array_equal(session.now.recorded, robots.source.frames[-1])  # type: ignore[arg-type]
    assert session.press(0).recorded is None


def test_beside_a_simulator_nothing_recorded_stands(session: PlaySession) -> None:
    session.press(1)
    assert session.start.recorded is None
    assert session.now.recorded is None
    assert session.now.true is not None


def test_the_page_says_what_stands_beside(agent: Agent, robots: RecordedStarts, tmp_path: Path) -> None:
    studio = Studio(agent.world_model, agent, robots, None, tmp_path, camera="observation.images.top")

    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        await user.should_see("recorded at the same step (0): it goes on by its own actions")
        for number in range(1, FRAMES):
            press(user, "1")
            await until(lambda: page.session.now.depth == number)  # noqa: B023
            press(user, "1", down=False)
        await until(lambda: f"({FRAMES - 1})" in page.true_title.text)
        assert page.true.visible
        assert not page.curve.visible
        shown = await user.http_client.get(page.true.source)
        with Image.open(io.BytesIO(shown.content)) as picture:
            assert np.array_equal(np.asarray(picture), robots.source.frames[FRAMES - 1])
        user.find(marker="record").click()
        await until(lambda: "recording-001" in page.controls.said.text)
        await page.down(2)
        await user.should_see("the recorded episode has ended")
        assert not page.true.visible

    simulate(studio, script)
    studio.close()
    info = json.loads((tmp_path / "recording-001" / "dataset" / "meta" / "info.json").read_text())
    assert [name for name, of in info["features"].items() if of["dtype"] == "image"] == ["observation.images.top"]


def test_an_animation_shows_the_recorded_frames_beside(agent: Agent, robots: RecordedStarts) -> None:
    session = PlaySession(agent.world_model)
    widths = []
    for start in (robots.start(0, 0), replace(robots.start(0, 0), recorded=None)):
        session.begin(start)
        session.press(1)
        with Image.open(io.BytesIO(pictures.session_animation(session.timeline.path(), 10.0))) as animation:
            widths.append(animation.width)
    assert widths[0] > 1.5 * widths[1]


def test_a_recording_goes_with_the_data_that_the_model_was_trained_on(session: PlaySession, tmp_path: Path) -> None:
    from playslot_rl.data.source import open_sources

    session.press(1)
    folder = record(session, tmp_path / "play", camera="observation.images.wrist")
    again = open_sources(folder / "dataset", "observation.images.wrist", tmp_path / "cache")
    assert np.array_equal(again.frames[0], session.timeline.moments[0].frame)


def test_the_camera_is_that_of_the_data_or_of_the_run(agent: Agent, robots: RecordedStarts) -> None:
    config = ExperimentConfig()
    named = replace(config, data=replace(config.data, camera="observation.images.side, observation.images.top"))
    assert play.run_camera(named, robots) == "observation.images.top"
    assert play.run_camera(named, None) == "observation.images.side"
    assert play.run_camera(replace(config, data=replace(config.data, camera="side")), None) == "observation.images.side"
    assert play.run_camera(config, None) == keys.FEATURE_IMAGE


def test_past_the_trained_horizon_the_page_says_so(agent: Agent, robots: RecordedStarts, tmp_path: Path) -> None:
    studio = Studio(agent.world_model, agent, robots, None, tmp_path, horizon=2)

    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        for _ in range(2):
            await page.down(1)
        page.up()
        assert not page.beyond.visible
        await page.down(1)
        await user.should_see("step 3: past the 2 steps that the model was trained to predict")
        await page.controls.undo()
        assert not page.beyond.visible

    simulate(studio, script)
    studio.close()


def test_the_horizon_is_that_of_the_runs_dynamics(tmp_path: Path) -> None:
    assert play.predicted_frames(Run.open("pretrained/block_push_easy")) == 24
    assert play.predicted_frames(Run.open("pretrained/button_press")) == 18
    run = tmp_path / "run"
    shutil.copytree(pretrained_folder("button_press"), run)
    assert play.predicted_frames(Run.open(run)) == 18


def test_the_page_says_which_prototypes_do_the_same(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        page.session.prototypes = page.session.prototypes.clone()
        page.session.directions = page.session.directions.clone()
        page.session.prototypes[3], page.session.directions[3] = page.session.prototypes[1], page.session.directions[1]
        page.controls.outdate()
        await until(lambda: "3 does the same as 1" in page.controls.same.text)
        await page.down(0)
        assert page.controls.same.text == "", "not yet known from here"

    simulate(studio, script)
