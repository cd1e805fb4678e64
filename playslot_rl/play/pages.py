"""The pages that are open: what each needs is made when its browser has connected, and freed when that has gone."""

from __future__ import annotations

import asyncio
from typing import Final

from nicegui import ui

from playslot_rl.play.page import PlayPage
from playslot_rl.play.pictures import Gallery
from playslot_rl.play.studio import Studio
from playslot_rl.visualization.document import style

MOST_PAGES: Final = 8
"""Open at a time: each has a simulator, and its moments in memory."""
PATIENCE_S: Final = 30.0
"""Seconds after which a browser that asked for the page, and has not connected, is forgotten."""

CLEAN: Final = "<script>history.replaceState(null, '', location.pathname)</script>"
"""The token leaves the address bar and the history; a cookie carries it on."""

AWAY: Final = "<script>window.addEventListener('blur', () => emitEvent('away'))</script>"
"""A key that is let go in another window is never told of."""

SPACE: Final = """<script>
for (const kind of ['keydown', 'keyup']) window.addEventListener(kind, (event) => {
  if (event.key !== ' ' || event.target.closest('input, textarea, select, [role=listbox], [contenteditable]')) return;
  if (event.target === document) return;
  event.preventDefault();
  event.stopImmediatePropagation();
  document.dispatchEvent(new KeyboardEvent(kind, event));
}, true);
</script>"""
"""Space plays; it does not press the button or the switch that has the focus as well. Enter presses it."""


def prepare(title: str) -> None:
    """Put this into the page; while its HTML is written, since scripts that come later do not run."""
    ui.page_title(title)
    ui.add_css(style())
    ui.query("body").classes("play")
    for script in (CLEAN, AWAY, SPACE):
        ui.add_body_html(script)


class Pages:
    """The pages of one studio."""

    def __init__(self, studio: Studio) -> None:
        self.studio = studio
        self.open: list[PlayPage] = []

    async def show(self) -> None:
        """One client's page: nothing but HTML until its socket is there, then a session of its own."""
        prepare("playslot play")
        client = ui.context.client
        await client.connected(PATIENCE_S)
        with ui.column() as waiting:
            ui.label(
                f"playslot play: {MOST_PAGES} pages are open, expected no more: close one of them, and this one begins"
            ).mark("full")
        waiting.set_visibility(False)
        while len(self.open) >= MOST_PAGES and not client.is_deleted:
            waiting.set_visibility(True)
            await asyncio.sleep(0.5)
        if client.is_deleted:
            return
        waiting.delete()
        page = PlayPage(self.studio, Gallery())
        self.open.append(page)
        client.on_delete(lambda: self.leave(page))
        page.build()

    def leave(self, page: PlayPage) -> None:
        """Free what a page has."""
        page.close()
        self.open.remove(page)
