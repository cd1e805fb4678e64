"""The local web server of the page: bound to this machine, for those whom the gate lets in, nothing from outside.

What an open page needs is made when its browser has connected, and freed when that has gone.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from typing import Final

from nicegui import app, core, ui
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from playslot_rl.errors import ConfigError
from playslot_rl.play.gate import HOST, Gate, GateMiddleware
from playslot_rl.play.page import PlayPage
from playslot_rl.play.pictures import PATH, Gallery
from playslot_rl.play.studio import Studio
from playslot_rl.visualization.document import style

MOST_PAGES: Final = 8
"""Open at a time: each has a simulator, and its moments in memory."""
CONNECT_S: Final = 30.0
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


class Pages:
    def __init__(self, studio: Studio) -> None:
        self.studio = studio
        self.open: list[PlayPage] = []

    async def show(self) -> None:
        """One client's page: nothing but HTML until its socket is there, then a session of its own."""
        ui.page_title("playslot play")
        ui.add_css(style())
        ui.query("body").classes("play")
        for script in (CLEAN, AWAY, SPACE):  # while the HTML is written: scripts that come later do not run
            ui.add_body_html(script)
        client = ui.context.client
        await client.connected(CONNECT_S)
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
        page.close()
        self.open.remove(page)


DEFAULT_PORT: Final = 8080
PATIENCE_S: Final = 10.0
"""Seconds after which a browser that does not answer has gone: a busy machine, or an import, may take some."""
TRIED: Final = 20
"""Ports looked at from the default one on."""


def choose_port(port: int) -> int:
    """The port to listen on, 0: the first free one from 8080 on; a ConfigError where it is taken, or not allowed."""
    candidates = [port] if port else list(range(DEFAULT_PORT, DEFAULT_PORT + TRIED))
    reason = ""
    for candidate in candidates:
        with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_STREAM)) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, candidate))
            except PermissionError:
                reason = "one that only root may open"
            except OSError:
                reason = "one that is taken"
            else:
                return candidate
    raise ConfigError(
        f"port={port or candidates[0]}: got {reason}, expected a free one: choose another, or leave it out"
    )


def serve_pictures() -> None:
    def picture(page: str, name: str, number: int) -> Response:
        del number  # it only makes the address new
        gallery = Gallery.open.get(page)
        found = None if gallery is None else gallery.get(name)
        if found is None:
            return Response(status_code=404)
        return Response(found[0], media_type=found[1], headers={"Cache-Control": "no-store"})

    if all(getattr(route, "path", "") != PATH for route in app.routes):
        app.add_api_route(PATH, picture, methods=["GET"], include_in_schema=False)


async def missing(request: Request, error: Exception) -> PlainTextResponse:  # noqa: ARG001
    """The answer for paths that are not there; NiceGUI would make a page for each."""
    return PlainTextResponse("playslot play: there is no such page, expected /\n", status_code=404)


def serve(studio: Studio, gate: Gate, show: bool) -> None:
    """Serve the page until Ctrl-C, then finish what is recorded; a ConfigError where the port has just been taken."""
    ui.page("/")(Pages(studio).show)
    serve_pictures()
    app.add_exception_handler(404, missing)
    core.sio.eio.cors_allowed_origins = gate.origins
    build = app.build_middleware_stack
    # The outermost of all: behind NiceGUI's own middleware a refusal would be cached as its assets are.
    app.build_middleware_stack = lambda: GateMiddleware(build(), gate)  # type: ignore[method-assign]
    try:
        with contextlib.suppress(KeyboardInterrupt):
            ui.run(
                host=HOST,
                port=gate.port,
                title="playslot play",
                show=gate.path if show else False,
                reload=False,
                dark=None,  # as the browser asks
                show_welcome_message=False,
                message_history_length=200,
                reconnect_timeout=PATIENCE_S,
            )
    except SystemExit as error:  # the web server's, which has said why
        if error.code:
            raise ConfigError(f"port={gate.port}: got a taken one, expected a free one: choose another") from None
    finally:
        studio.close()
