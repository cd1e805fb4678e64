"""The page's row for time: undo, reset, a slider over the branch that is played, a list of all branches."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from nicegui import events, ui

from playslot_rl.play.session import PlaySession


class TimePanel:
    """Where the player is in the timeline, and ways to go elsewhere.

    Args:
        session: what is played.
        work: has the worker do something with it, and the page show what came of it.
        halt: ends free play.
    """

    def __init__(
        self, session: PlaySession, work: Callable[[Callable[[], Any]], Awaitable[Any]], halt: Callable[[], None]
    ) -> None:
        self.session, self._work, self._halt = session, work, halt
        self._begun = self._showing = False

    def build(self) -> None:
        """Lay the row out."""
        with ui.row().classes("items-center gap-2 w-full"):
            ui.button("Undo", on_click=self.undo).props("dense no-caps").mark("undo")
            ui.button("Reset", on_click=self.reset).props("dense no-caps").mark("reset")
            self.place = ui.slider(min=0, max=1, step=1, value=0, on_change=self._on_place).props("label")
            self.place.classes("w-64").mark("place")
            self.tips = ui.select({0: "start"}, value=0, on_change=self._on_tip, label="branch").props("dense")
            self.tips.classes("w-48").mark("tips")

    def show(self, moments: int, *, branches: bool) -> None:
        """The present moment, without setting off the handlers.

        Args:
            moments: of the branch that is played.
            branches: also list all branches.
        """
        timeline, self._showing = self.session.timeline, True
        self.place.props(f"max={max(1, moments - 1)}")
        self.place.set_value(timeline.now.depth)
        if branches:
            tips = {tip.number: f"{tip.depth} moments, {tip.label}" for tip in timeline.tips()}
            self.tips.set_options(tips, value=timeline.branch()[-1].number)
        self._begun, self._showing = True, False

    async def undo(self) -> None:
        """One moment back."""
        await self._work(self.session.undo)

    async def reset(self) -> None:
        """Back to the start."""
        self._halt()
        await self._work(self.session.reset)

    def _on_place(self, event: events.ValueChangeEventArguments[float | None]) -> Awaitable[Any] | None:
        if self._showing or not self._begun or event.value is None:
            return None
        branch = self.session.timeline.branch()
        number = branch[min(int(event.value), len(branch) - 1)].number
        return self._work(lambda: self.session.go(number))

    def _on_tip(self, event: events.ValueChangeEventArguments[Any]) -> Awaitable[Any] | None:
        if self._showing or not self._begun or event.value is None:
            return None
        return self._work(lambda: self.session.go(int(event.value)))
