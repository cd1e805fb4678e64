"""The page without a browser: what is clicked and pressed does what it says; pages come and go; a taken port."""

from __future__ import annotations

import asyncio
import json
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `play` is not installed")

from nicegui.testing import User
from page_script import MOUSE, press, simulate, until
from scene import DotTask

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.experiment import DataConfig
from playslot_rl.envs import task_config
from playslot_rl.errors import ConfigError, DataError
from playslot_rl.play.page import PlayPage
from playslot_rl.play.pictures import Gallery
from playslot_rl.play.server import choose_port
from playslot_rl.play.starts import RecordedStarts
from playslot_rl.play.studio import Studio
from playslot_rl.recipes import play
from playslot_rl.runs import Run
from playslot_rl.testing import tiny_agent, tiny_config
from playslot_rl.world_model import Agent

pytestmark = pytest.mark.integration


def test_keys_step_undo_and_reset_and_the_buttons_touch_and_record(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        session = page.session
        await user.should_see("moment 0, start")
        for number, key in enumerate("21", 1):
            press(user, key)
            await until(lambda: session.now.depth == number)  # noqa: B023
            press(user, key, down=False)
        assert session.now.label == "prototype 1"
        press(user, "u")
        await until(lambda: session.now.depth == 1)
        user.find(marker="scene").trigger(
            "mouse", {"mouse_event_type": "mousedown", "image_x": 20, "image_y": 30, **MOUSE}
        )
        await until(lambda: page.chosen is not None)
        user.find(marker="freeze").click()
        await until(lambda: bool(session.now.frozen))
        user.find(marker="remove").click()
        await until(lambda: len(session.now.present) == 3)
        await until(lambda: page.chosen is None)
        user.find(marker="record").click()
        await until(lambda: "recording-001" in page.controls.said.text)
        picture = await user.http_client.get(page.scene.source)
        assert picture.content.startswith(b"\x89PNG")
        assert picture.headers["cache-control"] == "no-store"
        press(user, "r")
        await until(lambda: session.now.number == 0)

    simulate(studio, script)
    assert (studio.out / "recording-001" / "dataset" / "meta" / "info.json").is_file()


def test_the_planner_steers_to_the_moment_that_goal_was_pressed_at(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        page.controls.hand.set_value("planner")
        await until(lambda: not page.free)  # no goal yet: it says so and stops
        assert page.session.now.depth == 0
        page.controls.hand.set_value("me")
        press(user, "2")
        await until(lambda: page.session.now.depth == 1)
        user.find(marker="goal").click()
        await until(lambda: page.session.planner is not None and page.session.planner.goal is not None)
        press(user, "r")
        await until(lambda: page.session.now.depth == 0)
        page.controls.hand.set_value("planner")
        await until(lambda: page.session.now.label == "planner")
        page.controls.free.set_value(False)

    simulate(studio, script)


@pytest.mark.parametrize("tasks", ["reach+push", "MT10"])
def test_the_policy_of_several_tasks_takes_over_for_one(tasks: str, studio: Studio) -> None:
    told = tiny_agent(replace(tiny_config(), env=task_config(f"metaworld/{tasks}")))

    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        page.controls.hand.set_value("policy: push")
        await until(lambda: page.session.now.depth >= 1)
        assert page.session.now.label == "latent policy: push"
        page.controls.free.set_value(False)

    simulate(replace(studio, world_model=told.world_model, agent=told), script)


def test_the_policy_takes_over_until_a_key_takes_back(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        page.fps = 15
        page.controls.hand.set_value("policy")
        await until(lambda: page.session.now.depth >= 2)
        assert page.session.now.label == "latent policy"
        press(user, "3")
        await until(lambda: page.session.now.label == "prototype 3")
        assert page.driver == "me"
        page.controls.free.set_value(False)
        await asyncio.sleep(0.2)
        depth = page.session.now.depth
        await asyncio.sleep(0.2)
        assert page.session.now.depth == depth

    simulate(studio, script)


def test_two_pages_play_apart_and_a_closed_one_ends(studio: Studio) -> None:
    open_before = DotTask.open_tasks

    async def script(user: User, pages: list[PlayPage]) -> None:
        await user.open("/")
        await until(lambda: len(pages) == 2 and pages[1].begun)
        pages[0].controls.hand.set_value("policy")
        await until(lambda: pages[0].session.now.depth >= 2)
        assert pages[1].session.now.depth == 0
        pages[0].close()
        await pages[1].down(1)
        assert pages[1].session.now.depth == 1
        assert not pages[0].ticker.active
        assert pages[0].gallery.key not in Gallery.open

    pages = simulate(studio, script)
    studio.close()
    assert all(page.closed for page in pages)
    assert DotTask.open_tasks == open_before


def test_without_a_policy_the_button_says_so(agent: Agent, recorded: RecordedStarts, tmp_path: Path) -> None:
    studio = Studio(agent.world_model, None, recorded, None, tmp_path)

    async def script(user: User, pages: list[PlayPage]) -> None:
        await user.should_see("this model has no policy: playslot train-policy makes one")
        await pages[0].down(0)
        assert pages[0].session.now.true is None

    simulate(studio, script)
    studio.close()


def test_actions_go_to_the_slot_under_the_mouse_where_each_has_its_own(studio_of_many: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page, owner = pages[0], pages[0].session.look().owner
        for slot in sorted(set(owner.flatten().tolist()))[:2]:
            y, x = np.argwhere(owner == slot)[0].tolist()
            place = {"image_x": x + 0.5, "image_y": y + 0.5, **MOUSE}
            user.find(marker="scene").trigger("mouse", {"mouse_event_type": "mousemove", **place})
            await until(lambda: page.under == slot)  # noqa: B023
            await page.down(1)
            assert page.session.now.label == f"prototype 1, slot {slot + 1}"
            await page.controls.undo()

    simulate(studio_of_many, script)


def test_an_upload_starts_anew_and_a_bad_one_is_told(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        await page.down(1)
        await page.work(lambda: page.session.begin(play_picture(page, b"nothing")), begins=True)
        assert page.session.now.depth == 1, "what was there goes on"
        assert any("got no picture that can be read" in str(message) for message in user.notify.messages)

    simulate(studio, script)


def play_picture(page: PlayPage, content: bytes) -> Any:
    """The start of an upload."""
    from playslot_rl.play.starts import picture_start

    return picture_start(page.studio.world_model, content, "upload.png")


def test_a_taken_port_is_refused_in_one_line_and_nothing_takes_the_next_free_one() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=f"^port={port}: got one that is taken, expected a free one"):
            choose_port(port)
        with pytest.raises(ConfigError, match=f"^port={port}: got one that is taken"):
            play.main(ExperimentConfig(run="pretrained", port=port))
    assert choose_port(0) >= 8080


def test_data_sets_of_a_run_may_be_gone_and_typed_ones_may_not(
    agent: Agent, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config = replace(ExperimentConfig(run=str(tmp_path)), data=DataConfig(root=f"{tmp_path}/elsewhere"))
    (tmp_path / "config.json").write_text(json.dumps(to_dict(config)))
    assert play.recorded_starts(config, Run(tmp_path), agent.world_model, None) is None
    assert "are not on this machine" in capsys.readouterr().out
    typed = replace(config, data=DataConfig(root=f"{tmp_path}/typo"))
    with pytest.raises(DataError, match="typo: got no data set, expected a LeRobot"):
        play.recorded_starts(typed, Run(tmp_path), agent.world_model, None)


def test_play_wants_a_run_and_a_data_set_that_is_there(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="run: got nothing, expected a run or a pretrained model"):
        play.open_studio(ExperimentConfig())
    config = ExperimentConfig(run="pretrained", device="cpu")
    config = replace(config, data=replace(config.data, root=str(tmp_path / "no")))
    with pytest.raises(DataError, match="no: got no data set, expected a LeRobot"):
        play.open_studio(config)
