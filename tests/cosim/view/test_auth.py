"""Access to the page: only with the token, and no client can spoil it for the others."""

import contextlib
import http.client
import re
import socket
import time
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

import msgspec
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.http11 import Request, Response
from websockets.sync.connection import Connection

from tests.support.cosim.view_pages import PATIENCE_S, TOKEN, VERSION, page_connection, unpacked
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.view import web_server
from vcmvsp.cosim.view.web_server import is_fit

pytestmark = pytest.mark.sockets


class Page:
    """A browser's requests to a server."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server, self.port = server, server.get_port()
        self.host = f"127.0.0.1:{self.port}"
        self.key = f"Bearer {TOKEN}"

    def get(self, path: str = "/", **headers: str) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        with contextlib.closing(connection):
            connection.request("GET", path, headers=headers)
            response = connection.getresponse()
            return response.status, dict(response.headers), response.read()

    def connect(self, **changed: Any) -> Connection:
        return page_connection(self.host, TOKEN, **changed)

    def hears(self, client: Connection) -> bool:
        """Whether an addition by the server reaches this client."""
        label = f"hello {time.monotonic_ns()}"
        folder = self.server.gui.add_folder(label)
        try:
            until_s = time.monotonic() + PATIENCE_S
            while time.monotonic() < until_s:
                with contextlib.suppress(TimeoutError):
                    if label.encode() in unpacked(client.recv(timeout=0.5)):
                        return True
            return False
        finally:
            folder.remove()


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """A served page."""
    server = web_server.open_server("127.0.0.1", 0, TOKEN)
    yield Page(server)
    web_server.close_server(server)


@pytest.mark.parametrize(
    ("path", "expected"),
    [(f"/?token={TOKEN}", 200), ("/", 403), ("/?token=", 403), ("/?token=wrong", 403), (f"/?token=wrong&token={TOKEN}", 403)],
)
def test_the_entry_has_no_secret_and_no_cookie(page: Page, path: str, expected: int) -> None:
    status, headers, body = page.get(path)
    assert status == expected
    assert "Set-Cookie" not in headers
    assert headers["Cache-Control"] == "no-store"
    assert b"<title>VCMVSP" in body
    assert TOKEN.encode() not in body


def test_the_page_requires_the_token_and_runs_only_its_own_scripts(page: Page) -> None:
    status, headers, body = page.get("/page", Authorization=page.key)
    assert status == HTTPStatus.OK
    assert "Set-Cookie" not in headers
    assert b"<title>Viser" in body
    policy = dict(each.split(" ", 1) for each in headers["Content-Security-Policy"].split("; "))
    assert policy["default-src"] == policy["frame-ancestors"] == "'none'"
    assert not {"'unsafe-inline'", "'self'", "*", "http:", "https:", "data:"} & {*policy["script-src"].split()}
    assert page.host in policy["connect-src"]
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"


def test_the_scripts_of_each_entry_have_their_own_nonce(page: Page) -> None:
    nonces = []
    for _ in range(2):
        _, headers, body = page.get("/")
        nonces += re.findall('<script nonce="([^"]+)">', body.decode())
        assert f"'nonce-{nonces[-1]}'" in headers["Content-Security-Policy"]
    assert len({*nonces}) == 2


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/page", {}),
        (f"/page?token={TOKEN}", {}),
        ("/page", {"Authorization": "Bearer wrong"}),
        ("/page", {"Authorization": "Bearer "}),
        ("/page", {"Authorization": TOKEN}),
        ("/page", {"Cookie": f"vcmvsp-view-PORT={TOKEN}"}),
        ("/index.html", {}),
        ("/page", {"Authorization": "KEY", "Host": "evil.example:PORT"}),
        ("/page", {"Authorization": "KEY", "Host": "127.0.0.1"}),
        ("/page", {"Authorization": "KEY", "Host": "127.0.0.1:PORT@evil.example"}),
        ("/page", {"Authorization": "KEY", "Host": "127.0.0.1:PORT#; script-src *"}),
        ("/page", {"Authorization": "KEY", "Host": "local\thost:PORT"}),
        ("/page", {"Authorization": "KEY", "Host": "10.0.0.1:PORT"}),
        ("/page", {"Authorization": "KEY", "Origin": "http://evil.example"}),
        ("/page", {"Authorization": "KEY", "Origin": "null"}),
        (f"/?token={TOKEN}", {"Host": "evil.example:PORT"}),
    ],
)
def test_a_foreign_request_is_refused(page: Page, path: str, headers: dict[str, str]) -> None:
    filled = {name: value.replace("KEY", page.key).replace("PORT", str(page.port)) for name, value in headers.items()}
    status, _, body = page.get(path, **filled)
    assert status == HTTPStatus.FORBIDDEN
    assert TOKEN.encode() not in body


@pytest.mark.parametrize("name", ["localhost", "LOCALHOST", "127.0.0.1"])
def test_all_own_names_are_accepted(page: Page, name: str) -> None:
    assert page.get("/page", Authorization=page.key, Host=f"{name}:{page.port}")[0] == HTTPStatus.OK


@pytest.mark.parametrize(
    ("changed", "status"),
    [
        ({"subprotocols": [VERSION]}, 403),
        ({"subprotocols": [VERSION, "token.wrong"]}, 403),
        ({"subprotocols": [VERSION], "additional_headers": {"Authorization": f"Bearer {TOKEN}"}}, 403),
        ({"origin": "http://evil.example"}, 403),
        ({"origin": None}, 403),
        ({"origin": "https://127.0.0.1:1"}, 403),
        ({"subprotocols": ["viser-v0.0.1", f"token.{TOKEN}"]}, 400),
        ({"subprotocols": [f"token.{TOKEN}"]}, 400),
        ({"subprotocols": None}, 403),
    ],
)
def test_a_foreign_connection_is_refused(page: Page, changed: dict[str, Any], status: int) -> None:
    with pytest.raises(InvalidStatus) as caught:
        page.connect(**changed).close()
    assert caught.value.response.status_code == status


@pytest.mark.parametrize("path", ["/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/..%5c..%5cetc", "//etc/passwd"])
def test_no_file_is_served_but_the_page(page: Page, path: str) -> None:
    status, _, body = page.get(path, Authorization=page.key)
    assert status == HTTPStatus.NOT_FOUND
    assert b"root:" not in body


@pytest.mark.parametrize(
    "message",
    [
        bytes((1 << 20) + 1),
        b"\xc1",
        b"",
        "a text",
        msgspec.msgpack.encode([1, 2]),
        b"\x91" * 5000,
        msgspec.msgpack.encode({"type": "NoSuchMessage"}),
        msgspec.msgpack.encode({"type": "ShareUrlRequest"}),
        msgspec.msgpack.encode({"type": "FileTransferStartUpload"}),
        msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": "x", "updates": {"update_cb": 1}}),
        msgspec.msgpack.encode({"type": "ViewerCameraMessage"}),
        msgspec.msgpack.encode({"type": "ViewerCameraMessage", "wxyz": "x", "position": 1, "extra": {}}),
    ],
    ids=range(12),
)
def test_an_invalid_message_ends_its_connection_quietly(
    page: Page, message: bytes | str, capfd: pytest.CaptureFixture[str]
) -> None:
    with page.connect() as good, page.connect() as bad:
        with contextlib.suppress(ConnectionClosed):
            bad.send(message)
        assert _is_closed(bad)
        assert page.hears(good)
    lines = "".join(capfd.readouterr()).splitlines()
    assert [line for line in lines if "zenoh" not in line] == []  # sessions of other tests may end late


def test_invalid_frames_end_their_connection_quietly(page: Page, capfd: pytest.CaptureFixture[str]) -> None:
    with page.connect() as good, page.connect() as bad:
        bad.socket.sendall(b"\xff\xff\xff\xff\xff")
        assert _is_closed(bad)
        with socket.create_connection(("127.0.0.1", page.port)) as rude:
            rude.sendall(b"\x16\x03\x01 this is no HTTP\r\n\r\n")
            rude.settimeout(PATIENCE_S)
            with contextlib.suppress(ConnectionError):
                assert b"101" not in rude.recv(100)
        assert page.hears(good)
    assert capfd.readouterr() == ("", "")


def test_the_number_of_pages_is_limited(page: Page) -> None:
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(page.connect())
        refused = []
        for _ in range(100):
            try:
                stack.enter_context(page.connect())
            except InvalidStatus as error:
                refused.append(error.response.status_code)
        assert refused == [HTTPStatus.SERVICE_UNAVAILABLE] * (100 + 1 - web_server.MOST_PAGES)
        assert page.hears(first)
    with page.connect() as later:
        assert page.hears(later)


@pytest.mark.parametrize("data", [b"", b"GET / HTTP/1.1\r\nHost: "], ids=["nothing", "half a request"])
def test_half_open_sockets_block_no_page(page: Page, data: bytes) -> None:
    with contextlib.ExitStack() as stack:
        first = stack.enter_context(page.connect())
        for _ in range(2 * web_server.MOST_SOCKETS):
            with contextlib.suppress(ConnectionError):  # closed as the oldest
                stack.enter_context(socket.create_connection(("127.0.0.1", page.port))).sendall(data)
        assert page.get("/page", Authorization=page.key)[0] == HTTPStatus.OK
        later = stack.enter_context(page.connect())
        assert page.hears(first)
        assert page.hears(later)


def test_a_taken_port_is_reported() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UsageError, match=f"cannot listen on 127.0.0.1:{port}: Address already in use; .*--view-port"):
            web_server.open_server("127.0.0.1", port, TOKEN)


@pytest.mark.parametrize(("host", "port"), [("no such host", 0), ("192.0.2.1", 0), ("127.0.0.1", 65536), ("127.0.0.1", -1)])
def test_a_bad_address_is_reported(host: str, port: int) -> None:
    with pytest.raises(UsageError, match="the view cannot listen on"):
        web_server.open_server(host, port, TOKEN)


def test_a_gate_that_lets_all_pass_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(web_server.Gate, "_answer", lambda *_: None)
    with pytest.raises(UsageError, match=r"cannot protect its page \(426\)"):
        web_server.open_server("127.0.0.1", 0, TOKEN)


def test_viser_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    web_server.close_server(web_server.open_server("127.0.0.1", 0, TOKEN))
    assert capfd.readouterr() == ("", "")


class FakeConnection:
    """The part of a connection that the rules use."""

    class server:  # noqa: N801
        connections: frozenset[object] = frozenset()

    def respond(self, status: HTTPStatus, text: str) -> Response:
        return Response(status, "", Headers(), text.encode())


values = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=40)
parts = st.sampled_from([TOKEN, "Bearer ", "token.", ",", VERSION, "localhost", ":", "8080", "http://", "evil", "@", "/"])


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["Host", "Origin", "Authorization", "Cookie", "Upgrade", "Sec-WebSocket-Protocol"]),
            values | st.lists(parts, max_size=4).map("".join),
        ),
        max_size=6,
    ),
    values | st.lists(parts | st.just("?token="), max_size=4).map("".join),
)
def test_only_requests_with_the_token_pass(headers: list[tuple[str, str]], path: str) -> None:
    gate = web_server.Gate("127.0.0.1", 8080, TOKEN, VERSION, "the page")
    response = gate.answer(FakeConnection(), Request("/" + path, Headers(headers)))  # type: ignore[arg-type]
    if response is None or response.body == b"the page":
        name, brings = ("Authorization", f"Bearer {TOKEN}") if response else ("Sec-WebSocket-Protocol", f"token.{TOKEN}")
        assert any(header == name and brings in value for header, value in headers)
        assert [value for name, value in headers if name == "Host"] == ["localhost:8080"]
        assert {value for name, value in headers if name == "Origin"} <= {"http://localhost:8080"}


things = st.recursive(
    st.none() | st.booleans() | st.floats() | st.binary(max_size=5) | st.sampled_from(["GuiUpdateMessage", "value", ""]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["type", "updates", "value"]), inner),
    max_leaves=6,
)


@given(st.binary(max_size=200) | things.map(msgspec.msgpack.encode))
def test_only_valid_messages_pass(message: bytes) -> None:
    if is_fit(message):
        content = msgspec.msgpack.decode(message)
        assert content["type"] == "GuiUpdateMessage"
        assert [*content["updates"]] == ["value"]


@pytest.mark.parametrize(
    ("host", "name", "let_in"),
    [
        ("0.0.0.0", "192.168.1.7", True),
        ("0.0.0.0", socket.gethostname(), True),
        ("0.0.0.0", "evil.example", False),
        ("::", "[fe80::1]", True),
        ("192.168.1.7", "192.168.1.7", True),
        ("192.168.1.7", "192.168.1.8", False),
        ("127.0.0.1", "192.168.1.7", False),
        ("::1", "[::1]", True),
    ],
)
def test_host_names_of_a_page(host: str, name: str, let_in: bool) -> None:
    gate = web_server.Gate(host, 8080, TOKEN, VERSION, "the page")
    request = Request("/page", Headers({"Host": f"{name}:8080", "Authorization": f"Bearer {TOKEN}"}))
    response = gate.answer(FakeConnection(), request)  # type: ignore[arg-type]
    assert response is not None
    assert (response.body == b"the page") == let_in


def _is_closed(client: Connection) -> bool:
    """Whether the server ends a connection soon, after any messages."""
    until_s = time.monotonic() + PATIENCE_S
    with contextlib.suppress(TimeoutError):
        while time.monotonic() < until_s:
            try:
                client.recv(timeout=PATIENCE_S)
            except ConnectionClosed:
                return True
    return False
