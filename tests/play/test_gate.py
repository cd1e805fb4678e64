"""Who gets in: raw requests and WebSockets to a real server, as another site, another program or a user sends them; and
how it ends."""

from __future__ import annotations

import asyncio
import http.client
import re
import signal
import subprocess
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest

pytest.importorskip("nicegui", reason="the extra `play` is not installed")

import socketio
from nicegui import __version__ as nicegui_version
from picture_file import png
from served import OUTPUT, served

from playslot_rl.play.gate import MOST_BODY, Gate
from playslot_rl.play.server import MOST_PAGES

pytestmark = pytest.mark.integration

SOCKET = "/_nicegui_ws/socket.io"
STATIC = f"/_nicegui/{nicegui_version}/static"
TRAVERSALS = [
    "/../../../../etc/passwd",
    "/%2e%2e/%2e%2e/%2e%2e/etc/passwd",
    "/..%2f..%2f..%2fetc/passwd",
    "/play/picture/..%2f..%2f/etc/passwd/0",
    "/play/picture/../../../../etc/passwd",
    "/play/picture/%2e%2e/%2e%2e%5c%2e%2e/0",
    f"{STATIC}/../../../../../../../etc/passwd",
    f"{STATIC}/%2e%2e/%2e%2e/nicegui.py",
    f"{STATIC}/..%2f..%2fnicegui.py",
    f"/_nicegui/{nicegui_version}/libraries/../../nicegui.py",
    f"/_nicegui/{nicegui_version}/components/%2e%2e%2f%2e%2e%2fnicegui.py",
    f"/_nicegui/{nicegui_version}/resources/x/../../../nicegui.py",
    f"/_nicegui/{nicegui_version}/esm/x/..%2f..%2fnicegui.py",
    "/runs/play/recording-001/session.gif",
    "/output.txt",
]


@dataclass(frozen=True)
class Server:
    """A server that runs, its port, the token of the printed address, and its folder and process."""

    port: int
    token: str
    folder: Path
    process: subprocess.Popen[str]

    @property
    def cookie(self) -> str:
        return f"playslot_{self.port}={self.token}"

    def ask(
        self, path: str, method: str = "GET", body: bytes = b"", known: bool = True, **headers: str
    ) -> tuple[int, dict[str, str], bytes]:
        """Status, headers and content of the answer to a request as it stands; `known` sends the cookie."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        connection.putrequest(method, path, skip_host=True, skip_accept_encoding=True)
        sent = {"Host": f"127.0.0.1:{self.port}", **({"Cookie": self.cookie} if known else {}), **headers}
        if body:
            sent.setdefault("Content-Length", str(len(body)))
        for name, value in sent.items():
            if value:
                connection.putheader(name.replace("_", "-"), value)
        connection.endheaders(body or None)
        answer = connection.getresponse()
        content = answer.read()
        connection.close()
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, content

    def knock(self, known: bool = True, **headers: str) -> int:
        """Status of the answer to a WebSocket's handshake; 101 opens it."""
        asked = {"Sec_WebSocket_Version": "13", "Sec_WebSocket_Key": "AAAAAAAAAAAAAAAAAAAAAA=="}
        headers = {"Connection": "Upgrade", "Upgrade": "websocket", **asked, **headers}
        return self.ask(f"{SOCKET}/?EIO=4&transport=websocket", known=known, **headers)[0]

    async def open_page(self) -> Page:
        """What a browser does: it asks for the page and connects its socket."""
        _, _, content = await asyncio.to_thread(self.ask, "/")
        client = re.search(rb"'client_id': '([0-9a-f-]+)'", content)
        assert client is not None
        socket, seen = socketio.AsyncClient(), list[str]()
        socket.on("*", lambda event, data=None: seen.append(str(data)))
        about = {"client_id": client[1].decode(), "document_id": uuid.uuid4(), "tab_id": uuid.uuid4()}
        query = urlencode({**about, "implicit_handshake": "true", "next_message_id": 0})
        await socket.connect(
            f"http://127.0.0.1:{self.port}?{query}", socketio_path=SOCKET,
            transports=["websocket"], headers={"Cookie": self.cookie}, wait_timeout=60,
        )  # fmt: skip
        return Page(socket, seen)


@dataclass(frozen=True)
class Page:
    """A page that is open, and what its browser was told."""

    socket: socketio.AsyncClient
    seen: list[str]

    async def hears(self, text: str) -> None:
        """Wait until the browser was told of a text, three minutes at most: other jobs may have the cores."""
        for _ in range(1800):
            if any(text in said for said in self.seen):
                return
            await asyncio.sleep(0.1)
        raise AssertionError(f"not told of {text!r} for three minutes, but of: {self.seen[-3:]}")


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """`playslot play` with a shipped model, and without the browser that it is to open."""
    folder, asked = tmp_path_factory.mktemp("gate"), ("run=pretrained/block_push_easy", "play.show=true")
    with served(folder, *asked, BROWSER=str(folder / "none")) as (address, process):
        found = re.fullmatch(r"http://127\.0\.0\.1:(\d+)/\?token=([\w-]{32,})", address)
        assert found is not None, address
        yield Server(int(found[1]), found[2], folder, process)


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "localhost.evil.example:{port}", ""]
)
def test_only_its_own_address_is_a_host(server: Server, host: str) -> None:
    """Else a name that its owner points at this machine would make another site's page one of ours."""
    host = host.format(port=server.port)
    status, _, content = server.ask("/", Host=host)
    assert status == 403
    assert b"client_id" not in content
    assert server.ask(f"{STATIC}/nicegui.js", Host=host)[0] == 403
    assert server.ask(f"{SOCKET}/?EIO=4&transport=polling", Host=host)[0] == 403
    assert server.knock(Host=host) in (400, 403)


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:1", "http://127.0.0.1", "https://127.0.0.1:{port}"]
)
def test_only_its_own_address_is_an_origin(server: Server, origin: str) -> None:
    origin = origin.format(port=server.port)
    status, headers, content = server.ask("/", Origin=origin)
    assert (status, headers["content-type"].split(";")[0]) == (403, "text/plain")
    assert content.startswith(b"playslot play: Origin: got another one")
    assert content.count(b"\n") == 1
    assert server.ask(f"{SOCKET}/?EIO=4&transport=polling", Origin=origin)[0] == 403
    assert server.ask("/_nicegui/client/x/upload/1", "POST", b"x", Origin=origin)[0] == 403
    assert server.knock(Origin=origin) == 403


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
def test_its_own_pages_get_in(server: Server, name: str) -> None:
    host = f"{name}:{server.port}"
    status, headers, content = server.ask("/", Host=host, Origin=f"http://{host}")
    assert status == 200
    assert b"client_id" in content
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["x-frame-options"] == "DENY"
    assert "set-cookie" not in headers
    assert server.ask(f"{SOCKET}/?EIO=4&transport=polling", Host=host, Origin=f"http://{host}")[0] == 200
    assert server.knock(Host=host, Origin=f"http://{host}") == 101


def test_without_the_token_nothing_is_served(server: Server) -> None:
    paths = [
        "/",
        "/?token=",
        "/?token=wrong",
        f"/?token={server.token}x",
        f"{STATIC}/nicegui.js",
        "/favicon.ico",
        "/none",
    ]
    for path in [*paths, "/play/picture/x/scene/0", f"{SOCKET}/?EIO=4&transport=polling"]:
        status, headers, content = server.ask(path, known=False)
        assert status == 403, path
        assert content.startswith(
            b"playslot play: token: got none or another one, expected that of the printed address"
        )
        assert content.count(b"\n") == 1
        assert headers["cache-control"] == "no-store", "not cached as an asset is"
    assert server.ask("/_nicegui/client/x/upload/1", "POST", b"x", known=False)[0] == 403
    assert server.knock(known=False) == 403
    assert server.ask("/", known=False, Cookie=f"playslot_{server.port}=wrong; other={server.token}")[0] == 403


def test_the_printed_address_sets_a_cookie_that_carries_the_token_on(server: Server) -> None:
    status, headers, content = server.ask(f"/?token={server.token}", known=False)
    assert status == 200
    cookie, *flags = headers["set-cookie"].split("; ")
    assert cookie == server.cookie
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} == set(flags)
    assert server.token.encode() not in content, "the page does not know it"
    for path in ("/", f"{STATIC}/nicegui.js", f"{SOCKET}/?EIO=4&transport=polling"):
        assert server.ask(path, known=False, Cookie=f'a=b c; {cookie}; d="e')[0] == 200


def test_each_server_has_a_token_of_its_own() -> None:
    first, second = Gate(8080), Gate(8080)
    assert first.token != second.token
    assert first.token not in repr(first)


def test_an_upload_above_the_limit_is_refused_before_it_is_sent(server: Server) -> None:
    """Its length is all that arrives; what hides its length is refused, too."""
    path = "/_nicegui/client/x/upload/1"
    status, _, content = server.ask(path, "POST", Content_Length=str(MOST_BODY + 1))
    assert status == 413
    assert content == f"playslot play: got an upload of {MOST_BODY + 1} bytes, expected at most 50 MB\n".encode()
    assert server.ask(path, "POST", Transfer_Encoding="chunked")[0] == 411
    assert server.ask(path, "POST", b"x")[0] == 404, "of a page that is not there"


@pytest.mark.parametrize("path", TRAVERSALS)
def test_no_path_leads_to_a_file_of_this_machine(server: Server, path: str) -> None:
    status, headers, content = server.ask(path)
    assert status in (403, 404, 405), path
    assert "set-cookie" not in headers
    assert not re.search(rb"root:|import |GIF8|http://", content), content[:100]


def test_an_uploaded_picture_is_bounded_in_bytes_and_pixels_and_its_name_is_no_path(server: Server) -> None:
    async def script() -> None:
        page = await server.open_page()
        await page.hears("moment 0, start")
        path = next(
            found[0] for said in page.seen if (found := re.search(r"/_nicegui/client/[0-9a-f-]+/upload/\d+", said))
        )

        async def upload(name: str, content: bytes, **how: Any) -> int:
            head = f'--x\r\nContent-Disposition: form-data; name="f"; filename="{name}"\r\n\r\n'.encode()
            body = head + content + b"\r\n--x--\r\n"
            kind = "multipart/form-data; boundary=x"
            return (await asyncio.to_thread(server.ask, path, "POST", body, Content_Type=kind, **how))[0]

        assert await upload("no.png", png(9, 9), known=False) == 403
        assert await upload("no.png", png(9, 9), Origin="http://evil.example") == 403
        assert await upload("bomb.png", png(50_000, 50_000)) == 200
        await page.hears("bomb.png: got too many pixels, expected at most 64 million: make it smaller")
        assert await upload("large.png", png(9000, 9000)) == 200
        await page.hears("large.png: got 9000x9000 pixels, expected at most 64 million: make it smaller")
        assert await upload("../../../cat.png", png(9, 9, bytes(28 * 9))) == 200
        await page.hears("cat.png; moment 0, start")
        assert not any("../cat" in said or "no.png" in said for said in page.seen)
        await page.socket.disconnect()

    asyncio.run(script())


def test_an_unknown_path_is_not_there_and_no_page(server: Server) -> None:
    for path in ("/nothing", "/index.html", "/play", "//", "/?x=1&/../y/z", "/api/x"):
        status, headers, content = server.ask(path)
        if path.startswith("/?"):
            assert status == 200
        else:
            assert (status, headers["content-type"].split(";")[0]) == (404, "text/plain"), path
            assert content == b"playslot play: there is no such page, expected /\n"


def test_a_session_begins_with_the_socket_and_a_page_too_many_waits_for_one_to_close(server: Server) -> None:
    async def script() -> None:
        for _ in range(MOST_PAGES + 2):  # nobody connects: they take nobody's place
            assert (await asyncio.to_thread(server.ask, "/"))[0] == 200
        pages = [await server.open_page() for _ in range(MOST_PAGES)]
        for page in pages:
            await page.hears("moment 0, start")
        late = await server.open_page()
        await late.hears(f"{MOST_PAGES} pages are open, expected no more: close one of them")
        assert not any("moment 0" in said for said in late.seen)
        await pages[3].socket.disconnect()
        await late.hears("moment 0, start")
        for page in (*pages, late):
            await page.socket.disconnect()

    asyncio.run(script())


def test_ctrl_c_ends_it_and_the_token_was_said_once(server: Server) -> None:
    """The last of this file: it ends the server."""
    server.process.send_signal(signal.SIGINT)
    _, err = server.process.communicate(timeout=60)
    out = (server.folder / OUTPUT).read_text()
    assert server.token in out.splitlines()[0]
    assert "stopped" in out
    assert "Traceback" not in err, err
    assert (out.count(server.token), err.count(server.token)) == (1, 0)
    assert server.process.returncode == 0
