"""The local web server of the page: bound to this machine, for those whom the gate lets in, nothing from outside."""

from __future__ import annotations

import contextlib
import socket
from typing import Final

from playslot_rl.errors import ConfigError
from playslot_rl.play.gate import HOST, Gate, GateMiddleware
from playslot_rl.play.pictures import PATH, Gallery
from playslot_rl.play.studio import Studio

DEFAULT_PORT: Final = 8080
PATIENCE_S: Final = 10.0
"""Seconds after which a browser that does not answer has gone: a busy machine, or an import, may take some."""
TRIED: Final = 20
"""Ports looked at from the default one on."""


def choose_port(port: int) -> int:
    """The port to listen on; 0 takes the first free one from 8080 on.

    Raises:
        ConfigError: it is taken, or not allowed.
    """
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
    """Tell the server of the galleries, once."""
    from nicegui import app
    from starlette.responses import Response

    def picture(page: str, name: str, number: int) -> Response:
        del number  # it only makes the address new
        gallery = Gallery.open.get(page)
        found = None if gallery is None else gallery.get(name)
        if found is None:
            return Response(status_code=404)
        return Response(found[0], media_type=found[1], headers={"Cache-Control": "no-store"})

    if all(getattr(route, "path", "") != PATH for route in app.routes):
        app.add_api_route(PATH, picture, methods=["GET"], include_in_schema=False)


def serve_nothing_else() -> None:
    """Answer paths that are not there with a plain 404; NiceGUI makes a page for each."""
    from nicegui import app
    from starlette.requests import Request
    from starlette.responses import PlainTextResponse

    async def missing(request: Request, error: Exception) -> PlainTextResponse:
        del request, error
        return PlainTextResponse("playslot play: there is no such page, expected /\n", status_code=404)

    app.add_exception_handler(404, missing)


def close_to_others(gate: Gate) -> None:
    """Put the gate before everything that the server serves, its WebSocket too."""
    from nicegui import app, core

    core.sio.eio.cors_allowed_origins = gate.origins
    build = app.build_middleware_stack
    # The outermost of all: behind NiceGUI's own middleware a refusal would be cached as its assets are.
    app.build_middleware_stack = lambda: GateMiddleware(build(), gate)  # type: ignore[method-assign]


def serve(studio: Studio, gate: Gate, show: bool) -> None:
    """Serve the page until Ctrl-C; what is being recorded is finished, and the studio closed.

    Raises:
        ConfigError: another program has just taken the port.
    """
    from nicegui import ui

    from playslot_rl.play.pages import Pages

    ui.page("/")(Pages(studio).show)
    serve_pictures()
    serve_nothing_else()
    close_to_others(gate)
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
