"""The page's controls without a browser: holding, previews, sliders, branches, starts, the slots' strip, swaps."""

from __future__ import annotations

import asyncio
import io

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="the extra `play` is not installed")

from nicegui.testing import User
from page_script import MOUSE, press, simulate, until
from PIL import Image

from playslot_rl.play.page import GAP, PlayPage
from playslot_rl.play.studio import Studio

pytestmark = pytest.mark.integration


def test_a_key_that_is_let_go_while_the_page_is_busy_still_steps_once(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        page.hold = True
        await page._lock.acquire()  # as while an animation is made
        press(user, "2")
        await asyncio.sleep(0.05)
        press(user, "2", down=False)
        await asyncio.sleep(0.05)
        page._lock.release()
        await until(lambda: page.session.now.depth == 1)
        await asyncio.sleep(0.3)
        assert page.session.now.depth == 1, "nothing is held any more"
        assert not page.ticker.active

    simulate(studio, script)


def test_a_held_key_steps_at_the_rate_that_is_set_and_ends_with_the_window(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        page.hold, page.fps = True, 2
        await page.down(1)
        assert page.session.now.depth == 1, "the first step is at once"
        await asyncio.sleep(0.25)
        assert page.session.now.depth == 1, "the second is a period later"
        await until(lambda: page.session.now.depth == 2)
        page.up()  # also what the browser's window calls when it loses the keyboard
        assert not page.ticker.active

    simulate(studio, script)


def test_after_a_stall_nothing_is_caught_up_with(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        page.fps = 2
        page.pressed, page._due = 1, 0.0  # long overdue
        await page._tick()
        await page._tick()
        assert page.session.now.depth == 1

    simulate(studio, script)


def test_previews_are_made_anew_for_the_slot_that_the_mouse_moves_to(studio_of_many: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page, owner = pages[0], pages[0].session.look().owner
        slots = sorted(set(owner.flatten().tolist()))[:2]
        page._point(slots[0])
        page.controls.stale = False
        page._point(slots[0])
        assert not page.controls.stale, "the same slot"
        page._point(slots[1])
        assert page.controls.stale
        page.controls.stale = False
        page._point(None)
        assert page.controls.stale

    simulate(studio_of_many, script)


def test_the_variability_slider_changes_what_a_press_does(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page, latents = pages[0], []
        for value in (0.0, 2.0):
            page.variability = value
            await page.down(1)
            page.up()
            latents.append(page.session.now.latent)
            await page.controls.undo()
        assert latents[0] is not None
        assert latents[1] is not None
        assert float((latents[0] - latents[1]).abs().max()) > 0

    simulate(studio, script)


def test_the_moment_slider_stays_on_the_branch_that_was_chosen(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page, session = pages[0], pages[0].session
        for keys in ((1, 2), (3, 3, 3)):
            for key in keys:
                await page.down(key)
                page.up()
            await page.controls.reset()
        old, new = session.timeline.tips()
        await page.work(lambda: None)
        page.controls.tips.set_value(old.number)
        await until(lambda: session.now.number == old.number)
        await until(lambda: page.controls.place.value == 2)
        page.controls.place.set_value(0)
        await until(lambda: session.now.number == 0)
        page.controls.place.set_value(2)
        await until(lambda: session.now.depth == 2)
        assert session.now.number == old.number, "not the newest child's branch"
        page.controls.tips.set_value(new.number)
        await until(lambda: session.now.number == new.number)

    simulate(studio, script)


def test_the_strip_chooses_a_slot_and_swap_puts_another_scenes_there(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page, side = pages[0], studio.world_model.env.image_size
        await page.swap()
        assert any("choose a slot first" in str(message) for message in user.notify.messages)
        place = {"image_x": 1.5 * (side + GAP), "image_y": 5, **MOUSE}
        user.find(marker="strip").trigger("mouse", {"mouse_event_type": "mousedown", **place})
        await until(lambda: page.chosen == 1)
        before = page.session.now.frame.copy()
        user.find(marker="swap").click()
        await until(lambda: page.session.now.depth == 1)
        assert "another scene" in page.session.now.label
        assert not np.array_equal(page.session.now.frame, before)

    simulate(studio, script)


def test_the_next_episode_and_an_uploaded_picture_start_anew(studio: Studio) -> None:
    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages[0]
        first = page.session.start.title
        await page.down(1)
        user.find(marker="next").click()
        await until(lambda: page.session.start.title != first and page.session.now.depth == 0)
        picture = io.BytesIO()
        Image.fromarray(np.full((96, 80, 3), 90, np.uint8)).save(picture, "png")
        await page.controls.on_upload(Upload(picture.getvalue()))  # type: ignore[arg-type]
        assert "scene.png" in page.session.start.title
        await page.controls.on_upload(Upload(b"nothing"))  # type: ignore[arg-type]
        assert "scene.png" in page.session.start.title, "what was there goes on"

    simulate(studio, script)


class Upload:
    """What the browser's upload brings."""

    name = "scene.png"

    def __init__(self, content: bytes) -> None:
        self.file, self._content = self, content

    async def read(self) -> bytes:
        return self._content
