"""The page's column of controls: steering, who steers, the chosen slot, time, where to start, recordings."""

from __future__ import annotations

import time
import weakref
from collections.abc import Awaitable, Callable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from nicegui import events, ui

from playslot_rl.play.recording import Shown, record
from playslot_rl.play.starts import MOST_BYTES, picture_start
from playslot_rl.play.steering import alike, in_words
from playslot_rl.play.timeline import Frame

if TYPE_CHECKING:
    from playslot_rl.play.page import PlayPage

ME: Final = "me"
REST_S: Final = 0.7
"""Seconds without a step after which the prototypes' animations are made anew."""
REFUSED: Final = f"got no picture, or one above {MOST_BYTES // 1_000_000} MB, expected a PNG or JPEG file"
"""What the browser does not send."""


class Controls:
    """What a player presses; the page does it. `stale`: the animations no longer show what the prototypes would do."""

    def __init__(self, page: PlayPage) -> None:
        self.page, self.session, self.studio = page, page.session, page.studio
        self.stale = False
        self._moved = 0.0
        self._showing = False  # sliders and lists that the page itself sets do nothing

    def build(self) -> None:
        groups = {
            "Steer": self._build_steering,
            "Who steers": self._build_drivers,
            "Chosen slot": self._build_touch,
            "Time": self._build_time,
            "Start from": self._build_starts,
            "Recording": self._build_record,
        }
        with ui.element("div").classes("controls"):
            for title, build in groups.items():
                with ui.element("section"):
                    ui.label(title).classes("title").props("role=heading aria-level=2")
                    build()

    def _build_steering(self) -> None:
        page = self.page
        self._previews: list[Any] = []
        with ui.element("div").classes("prototypes"):
            for number in range(len(self.session.prototypes)):
                button = ui.button(color=None).props("flat no-caps padding=0").mark(f"prototype-{number}")
                with button, ui.element("div").classes("proto"):
                    self._previews.append(ui.image().props("no-spinner no-transition"))
                    ui.label(str(number))
                button.tooltip(f"prototype {number}: key {number}")
                button.on("pointerdown", lambda _, k=number: page.down(k))
                for event in ("pointerup", "pointerleave", "pointercancel"):
                    button.on(event, lambda _: page.up())
        self.same = ui.label("").classes("soft").mark("same")
        with ui.element("div").classes("line"):
            ui.label("A press makes")
            presses = {False: "one step", True: "steps while held"}
            ui.toggle(presses, value=False).props("dense no-caps").bind_value(page, "hold")
        amount = ui.label().bind_text_from(page, "variability", lambda s: f"Variability {s:+.1f} standard deviations")
        slider = ui.slider(min=-3, max=3, step=0.1, value=0, on_change=self.outdate).mark("variability")
        slider.props('aria-label="variability"').bind_value(page, "variability")
        if not self.session.varies:
            slider.disable()
            amount.set_visibility(False)
            ui.label("No variability: the predictor of this model sees prototypes only.").classes("soft")

    def _build_drivers(self) -> None:
        page = self.page
        names = {ME: "I steer", **{name: driver.title for name, driver in self.session.drivers.items()}}
        self.hand = ui.toggle(names, value=ME, on_change=page.on_driver).props("dense no-caps").mark("driver")
        self.hand.style("flex-wrap: wrap")  # of many tasks no row is wide enough
        if self.session.agent is None:
            ui.label("this model has no policy: playslot train-policy makes one").classes("soft").mark("no-policy")
        if self.session.planner is not None:
            goal = ui.button("Make this moment the planner's goal", on_click=page.on_goal)
            goal.props("dense no-caps outline").mark("goal")
        self.free = ui.switch("Go on by itself", on_change=page.on_free).props("dense").mark("free")
        with ui.element("div").classes("line"):
            ui.label().bind_text_from(page, "fps", lambda fps: f"{fps:g} frames a second")
            speed = ui.slider(min=1, max=15, step=1, value=page.fps).props('aria-label="frames a second"')
            speed.bind_value(page, "fps")

    def outdate(self) -> None:
        self.stale, self._moved = True, time.monotonic()
        self.same.set_text("")

    @property
    def due(self) -> bool:
        """Whether the animations are to be made anew: they are outdated, and the player has paused."""
        return self.stale and time.monotonic() - self._moved > REST_S

    async def refresh(self, animate: Callable[[int], Awaitable[tuple[Frame, bytes] | None]]) -> None:
        """Make the animations anew, one after the other, so that a key waits for one; ends where one is not made."""
        self.stale, seen = False, []
        for number, picture in enumerate(self._previews):
            made = await animate(number)
            if made is None:
                return
            seen.append(made[0])
            picture.set_source(self.page.gallery.put(f"prototype-{number}", made[1], "image/gif"))
        self.same.set_text(in_words(alike(np.stack(seen))))

    def _build_touch(self) -> None:
        self.which = ui.label("").mark("which")
        with ui.element("div").classes("line"):
            self.freezing = ui.button("Freeze", on_click=self.page.freeze).mark("freeze")
            others = (("Remove", self.page.remove), ("Swap with another", self.page.swap))
            for button in (self.freezing, *(ui.button(t, on_click=w).mark(t.split()[0].lower()) for t, w in others)):
                button.props("dense no-caps outline")

    def _show_slot(self) -> None:
        slot, frozen = self.page.chosen, self.session.now.frozen
        none = "None: click one in a picture" + ("; actions go to all" if self.session.per_slot else "")
        self.which.set_text(none if slot is None else f"Slot {slot + 1}{', frozen' if slot in frozen else ''}")
        self.freezing.set_text("Let go" if slot in frozen else "Freeze")

    def _build_time(self) -> None:
        with ui.element("div").classes("line"):
            ui.button("One moment back", on_click=self.undo).props("dense no-caps outline").mark("undo")
            ui.button("Back to the start", on_click=self.reset).props("dense no-caps outline").mark("reset")
        with ui.element("div").classes("line"):
            self.at = ui.label("")
            self.place = ui.slider(min=0, max=1, step=1, value=0, on_change=self._on_place).mark("place")
            self.place.props('label aria-label="moment"')
        self.tips = ui.select({0: "start"}, value=0, on_change=self._on_tip, label="branch").props("dense").mark("tips")

    def show(self, *, branches: bool) -> None:
        """The present moment, without setting off the handlers; with `branches`, list all branches too."""
        timeline, self._showing = self.session.timeline, True
        branch = timeline.branch()
        self.place.props(f"max={max(1, len(branch) - 1)}")
        self.place.set_value(timeline.now.depth)
        self.at.set_text(f"Moment {timeline.now.depth} of {len(branch) - 1}")
        if branches:
            tips = {tip.number: f"moment {tip.depth}: {tip.label}" for tip in timeline.tips()}
            self.tips.set_options(tips, value=branch[-1].number)
        self._showing = False
        self._show_slot()

    async def undo(self) -> None:
        await self.page.work(self.session.undo)

    async def reset(self) -> None:
        self.page.halt()
        await self.page.work(self.session.reset)

    def _on_place(self, event: events.ValueChangeEventArguments[float | None]) -> Awaitable[Any] | None:
        if self._showing or not self.page.begun or event.value is None:
            return None
        branch = self.session.timeline.branch()
        number = branch[min(int(event.value), len(branch) - 1)].number
        return self.page.work(lambda: self.session.go(number))

    def _on_tip(self, event: events.ValueChangeEventArguments[Any]) -> Awaitable[Any] | None:
        if self._showing or not self.page.begun or event.value is None:
            return None
        return self.page.work(lambda: self.session.go(int(event.value)))

    def _build_starts(self) -> None:
        sources = self.studio.sources
        # The web framework remembers a few thousand upload routes of pages that are gone, and what they can reach.
        me = weakref.ref(self)

        async def uploaded(event: events.UploadEventArguments) -> None:
            controls = me()
            if controls is not None:
                await controls.on_upload(event)

        first = next(iter(sources), "")
        self.source = ui.select(sources or {"": "no data set, no simulator"}, value=first).props("dense").mark("source")
        with ui.element("div").classes("line"):
            self.number = ui.number("episode", value=0, min=0, step=1, format="%d").props("dense")
            self.step = ui.number("frame", value=0, min=0, step=1, format="%d").props("dense")
            self.step.bind_visibility_from(self.source, "value", value="recorded")
            ui.button("Start here", on_click=self._on_start).props("dense no-caps outline").mark("start")
            ui.button("Next episode", on_click=self._on_next).props("dense no-caps outline").mark("next")
        ui.upload(
            label="Start from a picture of yours",
            auto_upload=True,
            on_upload=uploaded,
            max_file_size=MOST_BYTES,
            on_rejected=lambda: ui.notify(REFUSED, type="warning"),
        ).props("accept=image/* flat bordered").mark("upload")

    async def _on_start(self) -> None:
        key = (str(self.source.value), int(self.number.value or 0), int(self.step.value or 0))
        self.page.halt()
        await self.page.start(lambda: self.studio.start(*key))

    async def _on_next(self) -> None:
        self.number.set_value(int(self.number.value or 0) + 1)
        await self._on_start()

    async def on_upload(self, event: events.UploadEventArguments) -> None:
        content, name, studio = await event.file.read(), event.file.name, self.studio
        self.page.halt()
        await self.page.start(lambda: picture_start(studio.world_model, content, name, whole=studio.squeezes))

    def _build_record(self) -> None:
        with ui.element("div").classes("line"):
            kinds = {"imagined": "imagined frames", "true": "the simulator's frames"}
            self.shown = ui.select(kinds, value="imagined").props("dense")
            ui.button("Record", on_click=self._on_record).props("dense no-caps outline").mark("record")
        self.said = ui.label("").classes("soft").mark("recorded")

    async def _on_record(self) -> None:
        shown: Shown = "true" if self.shown.value == "true" else "imagined"
        made: list[str] = []
        self.said.set_text("recording ...")
        studio = self.studio
        done = await self.page.work(lambda: made.append(str(record(self.session, studio.out, shown, studio.camera))))
        self.said.set_text(f"written: {made[0]}" if done else "")
