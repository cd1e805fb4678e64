"""The page: one player's view of a session, by NiceGUI; what it does is in `playslot_rl.play.session`."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from nicegui import events, ui

from playslot_rl.errors import PlaySlotError, explain
from playslot_rl.frames import png
from playslot_rl.play import pictures
from playslot_rl.play.controls import ME, Controls
from playslot_rl.play.pictures import Gallery
from playslot_rl.play.starts import Start
from playslot_rl.play.studio import Studio
from playslot_rl.play.timeline import Frame

TICK_S: Final = 0.02
GAP: Final = 4

HELP: Final = (
    "Keys: 0 to 9 press a prototype, U goes one moment back, R to the start, space goes on by itself, M colours the "
    "slots."
)


class PlayPage:
    """The page of one client; the gallery serves its pictures."""

    def __init__(self, studio: Studio, gallery: Gallery) -> None:
        self.studio, self.gallery = studio, gallery
        self.session = studio.session()
        self.begun = self.closed = False
        self.masks, self.driver, self.hold = False, ME, False
        self.chosen: int | None = None
        self.under: int | None = None  # the slot under the mouse, where each has actions of its own
        self._owner: npt.NDArray[np.int64] | None = None
        self.pressed: int | None = None  # the prototype that is held, or that free play goes on with
        self.free, self.variability, self.fps = False, 0.0, studio.fps
        self.donor = 0
        self._due = 0.0
        self._lock = asyncio.Lock()
        self.controls = Controls(self)

    def build(self) -> None:
        """Lay the page out; the session begins when it is there."""
        with ui.element("div").classes("layout"):
            with ui.element("main").classes("scene"):
                self._build_scene()
            self.controls.build()
        ui.keyboard(on_key=self._on_key, repeating=False, ignore=["input", "select", "textarea"])
        ui.on("away", self.up)
        self.ticker = ui.timer(TICK_S, self._tick, active=False)
        ui.timer(0.4, self._refresh_previews)
        ui.timer(0.05, self._begin, once=True)

    def _build_scene(self) -> None:
        side, n = self.studio.world_model.env.image_size, self.studio.world_model.slot_shape[0]
        watched = ["mousedown", "mousemove"] if self.session.per_slot else ["mousedown"]
        ui.label(self.studio.title).classes("name").props("role=heading aria-level=1")
        self.status = ui.label("starting ...").mark("status")
        self.beyond = ui.label("").classes("warning").mark("beyond")
        self.beyond.set_visibility(False)
        with ui.element("div").classes("pair"):
            with ui.element("figure"):
                self.scene = ui.interactive_image(size=(side, side), on_mouse=self._on_scene, events=watched)
                self.scene.classes("pixels").mark("scene").on("mouseleave", lambda _: self._point(None))
                ui.label("imagined").classes("soft")
            with ui.element("figure") as self.true_column:
                self.true = ui.interactive_image(size=(side, side)).classes("pixels")
                self.true_title = ui.label("").classes("soft").mark("beside")
        masks = ui.switch("Colour the slots", on_change=lambda: self.work(lambda: None)).props("dense")
        masks.mark("masks").bind_value(self, "masks")
        width = n * side + (n - 1) * GAP
        self.strip = ui.interactive_image(size=(width, side), on_mouse=self._on_strip, events=["mousedown"])
        self.strip.classes("pixels").mark("strip")
        ui.label("What each slot draws. Click a slot here or in the imagined picture to choose it.").classes("soft")
        self.curve = ui.html("", sanitize=False).classes("curve").mark("curve")
        self.curve_title = ui.label("Difference of the two pictures at each moment (RMS, of 1)").classes("soft")
        ui.label(HELP).classes("soft keys")

    async def work(self, work: Callable[[], Any], *, begins: bool = False) -> bool:
        """Have the worker do something with the session and show what came of it; an error is told in one line."""
        async with self._lock:
            if self.closed or not (self.begun or begins):
                return False
            try:
                await self.studio.do(work)
                if begins:
                    self.chosen = None
                drawn = await self.studio.do(self._paint)
                self.begun = True  # only now: the mouse needs to know what it points at
            except Exception as error:
                if self._left():
                    return False  # what it was about is gone
                self.halt()
                known = isinstance(error, (PlaySlotError, ValueError))
                if not known:
                    logging.getLogger(__name__).error("play", exc_info=error)
                said = str(error) if type(error) is ValueError else explain(error)
                ui.notify(said, type="warning" if known else "negative")
                return False
            if not self.closed:
                self._show(drawn)
            return True

    def _paint(self) -> dict[str, bytes]:
        """The pictures of the present moment; in the worker."""
        session = self.session
        if self.chosen is not None and self.chosen not in session.now.present:
            self.chosen = None
        look = session.look()
        self._owner = look.owner
        found = {"scene": png(pictures.with_masks(look, self.chosen) if self.masks else look.frame, level=1)}
        beside = session.now.recorded if session.now.true is None else session.now.true
        if beside is not None:
            found["beside"] = png(beside, level=1)
        found["strip"] = png(pictures.strip(look, session, self.chosen, GAP), level=1)
        return found

    def _show(self, drawn: dict[str, bytes]) -> None:
        session, timeline = self.session, self.session.timeline
        self.scene.set_source(self.gallery.put("scene", drawn["scene"]))
        self.strip.set_source(self.gallery.put("strip", drawn["strip"]))
        branch, now = timeline.branch(), session.now
        self._show_beside(drawn.get("beside"))
        for element in (self.curve_title, self.curve):
            element.set_visibility(now.true is not None)
        if now.true is not None:
            self.curve.set_content(pictures.error_curve([moment.error for moment in branch], session.now.depth))
        # The list of branches is long, and nobody reads it while it grows.
        self.controls.show(branches=not self.ticker.active)
        error = "" if now.error is None else f", error {now.error:.3f}"
        self.status.set_text(f"{session.start.title}; moment {now.depth}, {now.label}{error}")
        horizon = self.studio.horizon
        past = 0 < horizon < now.steps
        self.beyond.set_visibility(past)
        if past:
            self.beyond.set_text(f"step {now.steps}: past the {horizon} steps that the model was trained to predict")
        self.controls.outdate()

    def _show_beside(self, picture: bytes | None) -> None:
        """What stands beside the imagined scene: the simulator, or the recorded episode."""
        now, recorded = self.session.now, self.session.start.recorded
        self.true_column.set_visibility(now.true is not None or recorded is not None)
        self.true.set_visibility(picture is not None)
        if picture is not None:
            self.true.set_source(self.gallery.put("beside", picture))
        title = "the recorded episode has ended"
        if picture is not None:
            title = f"recorded at the same step ({now.steps}): it goes on by its own actions"
        if now.true is not None:
            title = "the simulator, after the decoded actions"
        self.true_title.set_text(title)

    @property
    def target(self) -> int | None:
        """The slot that actions go to: the one under the mouse, else the chosen one; None where all share one."""
        if not (self.begun and self.session.per_slot):
            return None
        found = self.chosen if self.under is None else self.under
        return found if found in self.session.now.present else None

    async def _step(self) -> None:
        driver, session = self.driver, self.session
        if driver != ME:
            await self.work(lambda: session.drive(driver))
        elif self.pressed is not None:
            k, s = self.pressed, self.variability
            slot = self.target
            await self.work(lambda: session.press(k, s, slot))

    async def _tick(self) -> None:
        """A step where one is due; the timer runs only while something is held or plays by itself."""
        now = time.monotonic()
        if now >= self._due and not self._lock.locked():
            period = 1.0 / self.fps
            self._due += period
            if self._due <= now:
                self._due = now + period  # no catching up after a stall
            await self._step()

    def _run(self) -> None:
        playing = self.free and (self.driver != ME or self.pressed is not None)
        self.ticker.active = playing or (self.hold and self.pressed is not None)

    def halt(self) -> None:
        self.free = False
        self.pressed = None
        self.controls.free.set_value(False)
        self._run()

    async def _refresh_previews(self) -> None:
        if self.closed or not self.begun or self.ticker.active or not self.controls.due:
            return
        self.controls.show(branches=True)
        slot = self.target

        def preview(number: int) -> tuple[Frame, bytes]:
            frames = self.session.preview([number], self.variability, slot)[0]
            return frames[1:], pictures.animated(frames)

        async def animate(number: int) -> tuple[Frame, bytes] | None:
            async with self._lock:
                if self.ticker.active:  # playing comes first
                    self.controls.outdate()
                if self.closed or self.controls.stale:
                    return None
                made = await self.studio.do(lambda: preview(number))
            return None if self.closed else made

        await self.controls.refresh(animate)

    async def _begin(self) -> None:
        source = next(iter(self.studio.sources), "")
        if not source or not await self.start(lambda: self.studio.start(source)):  # or it cannot be read
            self.status.set_text("nothing to start from: choose another start, upload a picture, or give data.root=")

    async def start(self, start: Callable[[], Start]) -> bool:
        return await self.work(lambda: self.session.begin(start()), begins=True)

    def _left(self) -> bool:
        return self.closed

    def close(self) -> None:
        """The client is gone: no more steps; the simulator is freed by the worker."""
        if not self.closed:
            self.closed = True
            self.ticker.active = False
            self.gallery.close()
            self.studio.call(self.session.close)

    async def _on_key(self, event: events.KeyEventArguments) -> None:
        number, name = event.key.number, str(event.key.name).lower()
        if number is not None and number < len(self.session.prototypes):
            if event.action.keydown:
                await self.down(number)
            elif event.action.keyup:
                self.up()
        elif not event.action.keydown:
            return
        elif name == "u":
            await self.controls.undo()
        elif name == "r":
            await self.controls.reset()
        elif name == "m":
            self.masks = not self.masks
        elif name in (" ", "space"):
            self.controls.free.set_value(not self.free)

    async def down(self, prototype: int) -> None:
        if self.driver != ME:
            self.controls.hand.set_value(ME)  # a press takes over
        self.pressed = prototype
        await self._step()  # at once: a key held for less than a period counts, too
        self._due = time.monotonic() + 1.0 / self.fps
        self._run()

    def up(self) -> None:
        if not self.free:
            self.pressed = None
        self._run()

    def on_free(self, event: events.ValueChangeEventArguments[bool | None]) -> None:
        self.free = bool(event.value)
        if not self.free:
            self.pressed = None
        elif self.driver == ME and self.pressed is None:
            self.pressed = 0
        self._run()

    def on_driver(self, event: events.ValueChangeEventArguments[Any]) -> None:
        self.driver = str(event.value)
        self.pressed = None
        self.controls.free.set_value(self.driver != ME)  # who gives back stops
        self._run()

    async def on_goal(self) -> None:
        session, planner = self.session, self.session.planner
        if planner is not None and await self.work(lambda: planner.aim(session)):
            ui.notify(f"goal: moment {session.now.depth}; go back, then let the planner steer")

    async def _on_scene(self, event: events.MouseEventArguments) -> None:
        if self._owner is None:
            return
        side = len(self._owner)
        x, y = (min(max(int(v), 0), side - 1) for v in (event.image_x, event.image_y))
        slot = int(self._owner[y, x])
        if event.type == "mousemove":
            self._point(slot)
        else:
            await self._choose(slot)

    def _point(self, slot: int | None) -> None:
        """The mouse is over a slot, or has left the picture."""
        before, self.under = self.target, slot
        if self.target != before:
            self.controls.outdate()

    async def _on_strip(self, event: events.MouseEventArguments) -> None:
        if not self.begun:
            return
        cell = int(event.image_x // (self.studio.world_model.env.image_size + GAP))
        if cell in self.session.now.present:
            await self._choose(cell)

    async def _choose(self, slot: int) -> None:
        self.chosen = slot
        await self.work(lambda: None)

    async def _touch(self, work: Callable[[int], Any]) -> None:
        slot = self.chosen
        if slot is None:
            ui.notify("choose a slot first: click it in the picture or in the strip", type="info")
        else:
            await self.work(lambda: work(slot))

    async def freeze(self) -> None:
        await self._touch(lambda slot: self.session.freeze(slot, slot not in self.session.now.frozen))

    async def remove(self) -> None:
        await self._touch(self.session.remove)

    async def swap(self) -> None:
        donors = self.studio.donors
        if donors is None:
            ui.notify("there is no other scene to take a slot from: give data.root=", type="info")
            return
        self.donor = (self.donor + 1) % len(donors)
        scene = donors[self.donor]
        await self._touch(lambda slot: self.session.swap(slot, scene[slot], f"another scene ({self.donor})"))
