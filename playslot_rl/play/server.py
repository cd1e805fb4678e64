"""The local web server of the page: bound to this machine, nothing from outside."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from typing import Final

from playslot_rl.errors import ConfigError
from playslot_rl.play.gallery import PATH, Gallery
from playslot_rl.play.studio import Studio

HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8080
TRIED: Final = 20
"""Ports looked at from the default one on."""


def choose_port(port: int) -> int:
    """The port to listen on.

    Args:
        port: the wanted one; 0 takes the first free one from 8080 on.

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


def page_root(studio: Studio) -> Callable[[], None]:
    """The function that builds each client's page."""

    def root() -> None:
        from playslot_rl.play.page import PlayPage

        serve_pictures()
        PlayPage(studio, Gallery()).build()

    return root


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


def serve(studio: Studio, port: int, show: bool) -> None:
    """Serve the page until Ctrl-C; what is being recorded is finished.

    Args:
        studio: closed at the end.
        port: that is free.
        show: open it in the browser too.

    Raises:
        ConfigError: another program has just taken the port.
    """
    from nicegui import ui

    try:
        with contextlib.suppress(KeyboardInterrupt):
            ui.run(
                page_root(studio),
                host=HOST,
                port=port,
                title="playslot play",
                show=show,
                reload=False,
                show_welcome_message=False,
                message_history_length=200,
            )
    except SystemExit as error:  # the web server's, which has said why
        if error.code:
            raise ConfigError(f"port={port}: got a taken one, expected a free one: choose another") from None
    finally:
        studio.close()
