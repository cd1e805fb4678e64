"""The page's row for recordings."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import ui

from playslot_rl.play.recording import Shown, record
from playslot_rl.play.session import PlaySession
from playslot_rl.play.studio import Studio


class RecordPanel:
    """Writes down what was played.

    Args:
        session: what is written.
        studio: knows where to, and the camera's name.
        work: has the worker do something; says whether it did.
    """

    def __init__(
        self, session: PlaySession, studio: Studio, work: Callable[[Callable[[], Any]], Awaitable[bool]]
    ) -> None:
        self.session, self.studio, self._work = session, studio, work

    def build(self) -> None:
        """Lay the row out."""
        with ui.row().classes("items-center gap-2"):
            kinds = {"imagined": "imagined frames", "true": "true frames"}
            self.shown = ui.select(kinds, value="imagined").props("dense")
            ui.button("Record", on_click=self._on_record).props("dense no-caps").mark("record")
            self.said = ui.label("").classes("text-sm").mark("recorded")

    async def _on_record(self) -> None:
        shown: Shown = "true" if self.shown.value == "true" else "imagined"
        made: list[str] = []
        self.said.set_text("recording ...")
        studio = self.studio
        done = await self._work(lambda: made.append(str(record(self.session, studio.out, shown, studio.camera))))
        self.said.set_text(f"written: {made[0]}" if done else "")
