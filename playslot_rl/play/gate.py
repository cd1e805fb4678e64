"""Who may use the page: requests to its own address, from its own pages, with the token of the printed address.

A web page of another site that the same browser shows can send requests to this machine and open WebSockets to it. It
cannot choose Host and Origin, and it does not know the token.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final
from urllib.parse import parse_qsl, urlencode

from starlette.responses import PlainTextResponse

from playslot_rl.play.starts import MOST_BYTES

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

HOST: Final = "127.0.0.1"
NAMES: Final = (HOST, "localhost")
"""What the page's own address may call this machine."""
TOKEN: Final = "token"
"""The part of the printed address that holds the token."""
MOST_BODY: Final = MOST_BYTES + 100_000
"""Of a request: a picture, and what a form puts round it."""
HEADERS: Final = {
    "referrer-policy": "no-referrer",
    "x-frame-options": "DENY",
    "cross-origin-resource-policy": "same-origin",
}
"""Of every answer: the address goes nowhere, and no other page shows this one or its pictures."""


@dataclass(frozen=True)
class Gate:
    """The page's own address, and the token without which nothing is served."""

    port: int
    token: str = field(default_factory=lambda: secrets.token_urlsafe(32), repr=False)

    @property
    def path(self) -> str:
        return f"/?{TOKEN}={self.token}"

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.port}{self.path}"

    @property
    def hosts(self) -> list[str]:
        return [f"{name}:{self.port}" for name in NAMES] + (list(NAMES) if self.port == 80 else [])

    @property
    def origins(self) -> list[str]:
        return [f"http://{host}" for host in self.hosts]

    @property
    def cookie(self) -> str:
        """Name of the cookie that carries the token on. Browsers hold one jar for all ports of a host."""
        return f"playslot_{self.port}"

    def is_token(self, candidates: Iterable[bytes]) -> bool:
        """Whether one of them is the token; the time that it takes does not tell how much of it is right."""
        return any(hmac.compare_digest(candidate, self.token.encode()) for candidate in candidates)

    def refusal(self, headers: list[tuple[bytes, bytes]]) -> str:
        """Why a request with these headers, names in small letters, is refused; empty where it is not."""
        hosts, origins = (_values(headers, name) for name in (b"host", b"origin"))
        if len(hosts) != 1 or hosts[0] not in self.hosts:
            return (
                f"Host: got another one, expected {self.hosts[0]}: open the printed address; a tunnel to this machine "
                f"has to have port {self.port} on both sides"
            )
        if any(origin not in self.origins for origin in origins):
            return f"Origin: got another one, expected {self.origins[0]}: a page of another site may not use this one"
        return ""


class GateMiddleware:
    """Asks the gate about every HTTP request and every WebSocket, assets included; the app never sees the token."""

    def __init__(self, app: ASGIApp, gate: Gate) -> None:
        self.app, self.gate = app, gate

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        headers = list(scope["headers"])
        query = parse_qsl(scope["query_string"].decode("latin-1"), keep_blank_values=True)
        named = [value.encode() for name, value in query if name == TOKEN]
        fresh = self.gate.is_token(named)
        status, line = self._refusal(headers, fresh)
        if status:
            await _refuse(scope, receive, send, status, line)
            return
        if named:
            rest = urlencode([pair for pair in query if pair[0] != TOKEN])
            scope = {**scope, "query_string": rest.encode()}
        await self.app(scope, receive, self._answering(send, fresh))

    def _refusal(self, headers: list[tuple[bytes, bytes]], known: bool) -> tuple[int, str]:
        """Status and line of a refusal; status 0 lets in. `known`: the address had the token."""
        elsewhere = self.gate.refusal(headers)
        if elsewhere:
            return 403, elsewhere
        if not known and not self.gate.is_token(_cookies(headers, self.gate.cookie)):
            return 403, "token: got none or another one, expected that of the printed address: open it as it is printed"
        length = dict(headers).get(b"content-length", b"0")
        if not length.isdigit() or _values(headers, b"transfer-encoding"):
            return 411, "got an upload of unknown length, expected a Content-Length"
        if int(length) > MOST_BODY:
            return 413, f"got an upload of {int(length)} bytes, expected at most {MOST_BYTES // 1_000_000} MB"
        return 0, ""

    def _answering(self, send: Send, fresh: bool) -> Send:
        extra = [(name.encode(), value.encode()) for name, value in HEADERS.items()]
        if fresh:
            cookie = f"{self.gate.cookie}={self.gate.token}; Path=/; HttpOnly; SameSite=Strict"
            extra.append((b"set-cookie", cookie.encode()))

        async def answer(message: Message) -> None:
            if message["type"] == "http.response.start":
                message = {**message, "headers": [*message.get("headers", []), *extra]}
            await send(message)

        return answer


def _values(headers: list[tuple[bytes, bytes]], name: bytes) -> list[str]:
    return [value.decode("latin-1").lower() for key, value in headers if key == name]


def _cookies(headers: list[tuple[bytes, bytes]], name: str) -> list[bytes]:
    """All values of a cookie, whatever else is in the headers."""
    pairs = [part.strip().partition(b"=") for key, value in headers if key == b"cookie" for part in value.split(b";")]
    return [value for key, _, value in pairs if key == name.encode()]


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int, line: str) -> None:
    """Answer with one plain line; a WebSocket is closed before it opens, which is a 403."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008, "reason": line[:120]})
        return
    closing = {"cache-control": "no-store", "connection": "close"}  # what is still being sent is not read
    await PlainTextResponse(f"playslot play: {line}\n", status, {**closing, **HEADERS})(scope, receive, send)
