"""The page's row for starts: a frame of an episode of data or of the simulator, or a picture that the user brings."""

from __future__ import annotations

import weakref
from collections.abc import Awaitable, Callable
from typing import Final

from nicegui import events, ui

from playslot_rl.play.picture import MOST_BYTES
from playslot_rl.play.starts import Start, picture_start
from playslot_rl.play.studio import Studio

REFUSED: Final = f"got no picture, or one above {MOST_BYTES // 1_000_000} MB, expected a PNG or JPEG file"
"""What the browser does not send."""


class StartPanel:
    """Where an imagined future begins.

    Args:
        studio: knows the starts.
        begin: has the session begin at a start, which the worker makes; says whether it did.
        halt: ends free play.
    """

    def __init__(
        self, studio: Studio, begin: Callable[[Callable[[], Start]], Awaitable[bool]], halt: Callable[[], None]
    ) -> None:
        self.studio, self._begin, self._halt = studio, begin, halt

    def build(self) -> None:
        """Lay the row out."""
        sources = self.studio.sources
        # The web framework remembers a few thousand upload routes of pages that are gone, and what they can reach.
        me = weakref.ref(self)

        async def uploaded(event: events.UploadEventArguments) -> None:
            panel = me()
            if panel is not None:
                await panel._on_upload(event)

        with ui.row().classes("items-center gap-2"):
            self.source = ui.select(sources or {"": "no data set, no simulator"}, value=next(iter(sources), ""))
            self.source.props("dense").mark("source")
            self.number = ui.number("episode", value=0, min=0, step=1, format="%d").props("dense").classes("w-20")
            self.step = ui.number("frame", value=0, min=0, step=1, format="%d").props("dense").classes("w-20")
            ui.button("Start here", on_click=self._on_start).props("dense no-caps").mark("start")
            ui.button("Next episode", on_click=self._on_next).props("dense no-caps flat").mark("next")
            ui.upload(
                label="or a picture",
                auto_upload=True,
                on_upload=uploaded,
                max_file_size=MOST_BYTES,
                on_rejected=lambda: ui.notify(REFUSED, type="warning"),
            ).props("accept=image/* dense flat bordered").classes("w-44").style("max-height: 56px; min-height: 0").mark(
                "upload"
            )

    async def first(self) -> bool:
        """Begin at the first frame of the first source; False where there is none to begin at, or it cannot be read."""
        source = next(iter(self.studio.sources), "")
        return bool(source) and await self._start_at((source, 0, 0))

    async def _start_at(self, key: tuple[str, int, int]) -> bool:
        return await self._begin(lambda: self.studio.start(*key))

    async def _on_start(self) -> None:
        self._halt()
        await self._start_at((str(self.source.value), int(self.number.value or 0), int(self.step.value or 0)))

    async def _on_next(self) -> None:
        self.number.set_value(int(self.number.value or 0) + 1)
        await self._on_start()

    async def _on_upload(self, event: events.UploadEventArguments) -> None:
        content, name, studio = await event.file.read(), event.file.name, self.studio
        self._halt()
        await self._begin(lambda: picture_start(studio.world_model, content, name, whole=studio.squeezes))
