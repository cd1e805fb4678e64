"""Pages that come and go: a session is there while its socket is, and nothing of it afterwards."""

from __future__ import annotations

import asyncio
import gc
import weakref
from typing import Any

import pytest

pytest.importorskip("nicegui", reason="the extra `play` is not installed")

from nicegui import Client
from nicegui.testing import User
from page_script import simulate, until
from scene import DotTask

from playslot_rl.play import server
from playslot_rl.play.page import PlayPage
from playslot_rl.play.pictures import Gallery
from playslot_rl.play.session import PlaySession
from playslot_rl.play.studio import Studio

pytestmark = pytest.mark.integration


def test_a_page_that_goes_takes_its_session_with_it(studio: Studio) -> None:
    """The moments and the simulator at once, the rest with the next collection: nothing else holds it."""
    simulators = DotTask.open_tasks

    async def script(user: User, pages: list[PlayPage]) -> None:
        page = pages.pop()
        await page.down(1)
        await asyncio.sleep(0.5)  # the timers have run
        held: list[weakref.ref[Any]] = [weakref.ref(part) for part in (page.session.timeline, page.session.start)]
        whole = [weakref.ref(page), weakref.ref(page.session), weakref.ref(page.scene)]
        assert DotTask.open_tasks == simulators + 1
        del page
        gc.disable()
        try:
            user._client.delete()
            await until(lambda: DotTask.open_tasks == simulators)
            await until(lambda: all(part() is None for part in held))
        finally:
            gc.enable()
        await asyncio.sleep(0.5)
        user.client = None
        gc.collect()
        assert [part() for part in whole] == [None, None, None]
        assert Gallery.open == {}
        await user.open("/")
        await until(lambda: bool(pages) and pages[0].begun)

    simulate(studio, script)


def test_plain_requests_make_no_session_and_are_forgotten(studio: Studio, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[PlaySession] = []
    session = studio.session
    monkeypatch.setattr(studio, "session", lambda: made.append(session()) or made[-1])
    monkeypatch.setattr(server, "CONNECT_S", 0.2)

    async def script(user: User, pages: list[PlayPage]) -> None:
        clients = len(Client.instances)
        for _ in range(20):
            assert (await user.http_client.get("/")).status_code == 200
        assert len(made) == len(pages) == 1
        await until(lambda: len(Client.instances) == clients)
        assert len(made) == 1

    simulate(studio, script)


def test_a_page_too_many_says_so_and_begins_when_another_one_has_gone(
    studio: Studio, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "MOST_PAGES", 1)

    async def script(user: User, pages: list[PlayPage]) -> None:
        first = user._client
        await user.open("/")
        await user.should_see("1 pages are open, expected no more: close one of them, and this one begins")
        assert len(pages) == 1
        third = await user.open("/")
        first.delete()
        third.delete()
        await until(lambda: len(pages) == 2 and pages[1].begun)
        assert pages[0].closed
        await asyncio.sleep(1.2)
        assert len(pages) == 2, "one that went while it waited does not begin"

    simulate(studio, script)
