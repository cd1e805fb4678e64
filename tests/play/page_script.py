"""Opening the page without a browser, and following a script on it."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import ui
from nicegui.testing import User, user_simulation

from playslot_rl.play.page import PlayPage
from playslot_rl.play.server import Pages, serve_pictures
from playslot_rl.play.studio import Studio

MOUSE: dict[str, Any] = {
    "button": 0, "buttons": 1, "altKey": False, "ctrlKey": False, "metaKey": False, "shiftKey": False,
}  # fmt: skip


def simulate(studio: Studio, script: Callable[[User, list[PlayPage]], Awaitable[None]]) -> list[PlayPage]:
    """Open the page and follow a script; the pages that were built."""
    pages: list[PlayPage] = []
    shared = Pages(studio)

    async def root() -> None:
        serve_pictures()
        await shared.show()
        pages.extend(page for page in shared.open if page not in pages)

    async def run() -> None:
        async with user_simulation(root) as user:
            await user.open("/")
            await until(lambda: bool(pages) and pages[0].begun)
            await script(user, pages)
            for page in list(shared.open):
                shared.leave(page)

    asyncio.run(run())
    return pages


async def until(true: Callable[[], bool]) -> None:
    """Wait for something to become true, half a minute at most: other jobs may have the cores."""
    for _ in range(3000):
        if true():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("nothing happened for half a minute")


def press(user: User, key: str, down: bool = True) -> None:
    """Press or let go a key."""
    code = f"Digit{key}" if key.isdigit() else f"Key{key.upper()}"
    event = {"action": "keydown" if down else "keyup", "repeat": False, "key": key, "code": code, "location": 0}
    flags = dict.fromkeys(("altKey", "ctrlKey", "shiftKey", "metaKey"), False)
    user.find(ui.keyboard).trigger("key", {**event, **flags})
