"""The page's row of prototypes: a button each, with a small animation of what holding it would do from here."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable
from typing import Any, Final

import numpy as np
from nicegui import ui

from playslot_rl.play.gallery import Gallery
from playslot_rl.play.likeness import alike, in_words
from playslot_rl.play.session import PlaySession
from playslot_rl.play.timeline import Frame

REST_S: Final = 0.7
"""Seconds without a step after which the animations are made anew."""


class PrototypePanel:
    """Buttons to steer by.

    Args:
        session: what is steered.
        gallery: serves the animations.
        down: a button is pressed.
        up: it is let go.
    """

    def __init__(
        self, session: PlaySession, gallery: Gallery, down: Callable[[int], Awaitable[None]], up: Callable[[], None]
    ) -> None:
        self.session, self._gallery, self._down, self._up = session, gallery, down, up
        self.stale = False
        self._moved = 0.0

    def build(self) -> None:
        """Lay the row out."""
        self._pictures: list[Any] = []
        with ui.row().classes("items-start gap-1"):
            for number in range(len(self.session.prototypes)):
                button = ui.button(color="white").props("dense no-caps padding=2px")
                with button, ui.column().classes("gap-0 items-center proto"):
                    self._pictures.append(ui.image().style("width: 66px; height: 66px"))
                    ui.label(str(number)).classes("text-black text-xs")
                button.mark(f"prototype-{number}").tooltip(f"prototype {number}: key {number}")
                button.on("mousedown", lambda _, k=number: self._down(k))
                for event in ("mouseup", "mouseleave"):
                    button.on(event, lambda _: self._up())
        self.same = ui.label("").classes("text-sm text-gray-500").mark("same")

    def outdate(self) -> None:
        """The animations no longer show what the prototypes would do."""
        self.stale, self._moved = True, time.monotonic()
        self.same.set_text("")

    @property
    def due(self) -> bool:
        """Whether they are to be made anew: they are outdated, and the player has paused."""
        return self.stale and time.monotonic() - self._moved > REST_S

    async def refresh(self, animate: Callable[[int], Awaitable[tuple[Frame, bytes] | None]]) -> None:
        """Make the animations anew, one after the other, so that a key waits for one; ends where one is not made.

        Args:
            animate: has the worker make a prototype's.
        """
        self.stale, seen = False, []
        for number, picture in enumerate(self._pictures):
            made = await animate(number)
            if made is None:
                return
            seen.append(made[0])
            picture.set_source(self._gallery.put(f"prototype-{number}", made[1], "image/gif"))
        self.same.set_text(in_words(alike(np.stack(seen))))
