"""Access control of the page: every request and every connection must carry the token from the printed URL.

The web server is viser's, which admits all clients. This module wraps its request handler in a gate: each request must carry
the token; the page's host name must be one of ours (against DNS rebinding); connections from other origins are rejected. After
the start the gate is tested, in case a new viser version bypasses it. The page is plain HTTP: for other machines, put an
SSH tunnel or a TLS proxy in front of it.

A browser loads ``entry.html``, which is public, with status 403 if the URL has no token. It keeps the token in
``sessionStorage``, which is separate for each tab and port, loads viser's page with it, and offers it as a sub-protocol when
that page connects. No cookie is used: browsers send cookies to all ports of a host.
"""

import asyncio
import contextlib
import hmac
import http.client
import ipaddress
import logging
import os
import secrets
import socket
import urllib.parse
import warnings
from collections.abc import Awaitable, Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from vcmvsp.cosim.errors import UsageError

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

ENTRY = (Path(__file__).parent / "entry.html").read_text("utf-8")
PAGE = "/page"  # path of viser's page
NO_TOKEN = "Open the printed URL, including its token.\n"  # noqa: S105  a sentence
MOST_PAGES = 32  # maximum number of connected pages
ANYWHERE = ("0.0.0.0", "::")  # noqa: S104  a word of the user's
LOOPBACK = ("127.0.0.1", "::1", "localhost")
_ACTS = {
    "Command": ("Trigger",),
    "Viewer": ("Camera",),
    "Gui": ("ButtonHold", "FormDirty", "FormSubmit", "Update"),
    "Scene": ("NodeClick", "NodeDrag", "Pointer"),
    "TransformControls": ("DragEnd", "DragStart", "Update"),
}
ALLOWED = {f"{part}{act}Message" for part, acts in _ACTS.items() for act in acts}
"""Messages that a page may send: the part of viser's that the control station uses. No uploads, no public tunnel."""
HEADERS = {
    "Cache-Control": "no-store",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
MOST_SOCKETS = 128  # maximum number of open sockets: connections of pages, requests, and half-open ones
LARGEST = 1 << 20  # bytes of a message from a page
CHECK_S = 10.0

_logger = logging.getLogger(__name__)
_logger.addHandler(logging.NullHandler())
_logger.propagate = False  # errors of unknown clients do not belong on the terminal


def caution(host: str) -> str:
    """Warning for a page that is visible to other machines; empty if it is not."""
    return "" if host in LOOPBACK else f"{host}: the page is unencrypted (plain HTTP): anyone on the network can read it\n"


def new_token() -> str:
    """Create an access token for a URL."""
    return secrets.token_urlsafe(24)


def client_name(host: str) -> str:
    """Host in a URL for clients of a server that listens at ``host``."""
    name = "localhost" if host in ANYWHERE else host
    return f"[{name}]" if ":" in name else name  # IPv6


def url_of(host: str, port: int, token: str) -> str:
    """URL of the page, for a browser."""
    return f"http://{client_name(host)}:{port}/?token={token}"


def is_fit(message: object) -> bool:
    """Whether a message from the page may be passed on."""
    if not isinstance(message, bytes):
        return False
    try:
        content = msgspec.msgpack.decode(message)
    except (ValueError, TypeError, RecursionError, msgspec.DecodeError):
        return False
    if not isinstance(content, dict) or not isinstance(kind := content.get("type"), str) or kind not in ALLOWED:
        return False
    if kind == "GuiUpdateMessage":  # other fields of a control would be set as well
        updates = content.get("updates")
        return isinstance(updates, dict) and updates.keys() == {"value"}
    return True


class Gate:
    """Admission of requests and connections."""

    def __init__(self, host: str, port: int, token: str, protocol: str, page: str) -> None:
        self.port, self._token, self._protocol, self._page = port, token.encode(), protocol, page
        self._names = {"127.0.0.1", "localhost", "::1", host.lower()}
        self._anywhere = host in ANYWHERE
        if self._anywhere:
            self._names.add(socket.gethostname().lower())

    def answer(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Response to a request; None: it may open a connection."""
        nonce = secrets.token_urlsafe(16)
        response = self._answer(connection, request, nonce)
        if response is not None:
            self._add_headers(request, response, nonce)
        return response

    def _answer(self, connection: "ServerConnection", request: "Request", nonce: str) -> "Response | None":
        headers = request.headers
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        upgrade = bool(headers.get_all("Upgrade"))
        if len(hosts) != 1 or not self._is_ours(hosts[0]):
            return connection.respond(HTTPStatus.FORBIDDEN, "This page has another host name: open the URL as printed.\n")
        own = {f"{scheme}://{hosts[0]}" for scheme in ("http", "https")}
        if not own.issuperset(origins) or len(origins) > 1 or (upgrade and not origins):
            return connection.respond(HTTPStatus.FORBIDDEN, "Pages of other sites may not connect to this one.\n")
        if upgrade:
            return self._connecting(connection, headers)
        path = request.path.partition("?")[0]
        if path == "/":
            has_token = self._has_token("", *_tokens(request.path)[:1])
            return _html(connection, HTTPStatus.OK if has_token else HTTPStatus.FORBIDDEN, ENTRY.replace("NONCE", nonce))
        if not self._has_token("Bearer ", *headers.get_all("Authorization")):
            return connection.respond(HTTPStatus.FORBIDDEN, NO_TOKEN)
        if path != PAGE:
            return connection.respond(HTTPStatus.NOT_FOUND, "Page not found.\n")
        return _html(connection, HTTPStatus.OK, self._page)

    def _connecting(self, connection: "ServerConnection", headers: "Headers") -> "Response | None":
        offered = [each.strip() for value in headers.get_all("Sec-WebSocket-Protocol") for each in value.split(",")]
        if not self._has_token("token.", *offered):
            return connection.respond(HTTPStatus.FORBIDDEN, NO_TOKEN)
        if self._protocol not in offered or headers.get_all("Upgrade") != ["websocket"]:
            return connection.respond(HTTPStatus.BAD_REQUEST, f"This server uses {self._protocol}: reload the page.\n")
        if len(connection.server.connections) >= MOST_PAGES:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_PAGES} pages are already connected: close one.\n")
        return None

    def _is_ours(self, host: str) -> bool:
        """Whether a Host header (name and port) belongs to this page."""
        try:
            parts = urllib.parse.urlsplit(f"//{host}")
            name, port = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if parts.netloc != host or parts.username is not None or port != self.port:  # name and port only
            return False
        return name in self._names or (self._anywhere and _is_address(name))  # DNS cannot rebind an address

    def _has_token(self, scheme: str, *candidates: str) -> bool:
        tokens = (each.removeprefix(scheme) for each in candidates if each.startswith(scheme))
        return any(hmac.compare_digest(token.encode(errors="replace"), self._token) for token in tokens)

    def _add_headers(self, request: "Request", response: "Response", nonce: str) -> None:
        hosts = request.headers.get_all("Host")
        own = f" ws://{hosts[0]} wss://{hosts[0]}" if len(hosts) == 1 and self._is_ours(hosts[0]) else ""
        rules = {
            "default-src": "'none'",
            "script-src": f"'nonce-{nonce}' 'unsafe-eval' blob:",  # viser's page unpacks itself, and its workers are blobs
            "style-src-elem": f"'nonce-{nonce}'",
            "style-src-attr": "'unsafe-inline'",  # words on the page are set with them
            "img-src": "'self' data: blob:",
            "font-src": "'self' data:",
            "connect-src": f"'self' data: blob:{own}",
            "worker-src": "'self' blob:",
            "base-uri": "'none'",
            "form-action": "'none'",
            "frame-ancestors": "'none'",
        }
        response.headers["Content-Security-Policy"] = "; ".join(f"{name} {value}" for name, value in rules.items())
        for name, value in HEADERS.items():
            response.headers[name] = value


def _html(connection: "ServerConnection", status: HTTPStatus, text: str) -> "Response":
    response = connection.respond(status, text)
    response.headers.pop("Content-Type", None)
    response.headers["Content-Type"] = "text/html; charset=utf-8"
    return response


def _tokens(path: str) -> list[str]:
    with contextlib.suppress(ValueError):
        return urllib.parse.parse_qs(urllib.parse.urlsplit(path).query).get("token", [])
    return []


def _is_address(name: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False


def open_server(host: str, port: int, token: str) -> "viser.ViserServer":
    """Start a web server that admits clients with the token.

    Raises:
        UsageError: the address cannot be used, or the gate does not work.
    """
    import viser
    from websockets.asyncio import server as served

    page = (Path(viser.__file__).parent / "client" / "build" / "index.html").read_text("utf-8")
    sock = _bound(host, port)
    gate = Gate(host, sock.getsockname()[1], token, f"viser-v{viser.__version__}", page)
    serve = served.serve

    def guarded(handler: Callable[..., Awaitable[None]], *_: object, **options: Any) -> object:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: _logger.debug("%s", context))
        options |= {"sock": sock, "max_size": LARGEST, "server_header": None}
        options |= {"logger": _logger, "create_connection": _connection(), "process_request": gate.answer}
        return serve(_calm(handler), **options)

    warnings.filterwarnings("ignore", r"\[viser\]")  # of messages that it does not understand
    served.serve = guarded  # type: ignore[assignment,misc]
    try:
        with quiet():
            server = viser.ViserServer(host=host, port=gate.port, verbose=False)
    finally:
        served.serve = serve  # type: ignore[misc]
    try:
        _try_gate(host, gate.port)
    except UsageError:
        close_server(server)
        raise
    return server


def close_server(server: "viser.ViserServer") -> None:
    """Stop listening."""
    with quiet():
        server.stop()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Suppress viser's output on the terminal."""
    import rich

    original = rich.print
    rich.print = lambda *_, **__: None
    try:
        yield
    finally:
        rich.print = original


def _bound(host: str, port: int) -> socket.socket:
    """A listening socket; viser would silently choose another port."""
    if not 0 <= port < 1 << 16:
        raise UsageError(f"the view cannot listen on port {port}: use 1 to 65535, or 0 for any free port")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=MOST_SOCKETS)
    except OSError as error:
        reason = error.strerror if isinstance(error, socket.gaierror) or error.errno is None else os.strerror(error.errno)
        hint = "choose another host or port (--view-host, --view-port)"
        raise UsageError(f"the view cannot listen on {host}:{port}: {reason}; {hint}") from error


def _connection() -> type["ServerConnection"]:
    """Connection class that limits the number of connections and the types of messages from a page."""
    from websockets.asyncio.server import ServerConnection
    from websockets.protocol import State

    class Guarded(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            brief = [each for each in self.server.handlers if each.state is not State.OPEN and not each.transport.is_closing()]
            if len(brief) > MOST_SOCKETS - MOST_PAGES:
                brief[0].transport.abort()  # the oldest: a genuine request is answered long before its turn

        async def recv(self, decode: bool | None = None) -> Any:
            while True:
                message = await super().recv(decode)
                if is_fit(message):
                    return message
                await self.close(1003, "this is no message of the page's")

    return Guarded


def _calm(handler: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    """Wrap a connection handler so that errors end only the connection."""

    async def handle(connection: "ServerConnection") -> None:
        try:
            await handler(connection)
        except Exception:
            _logger.debug("a connection has ended", exc_info=True)
            await connection.close(1003, "this is no message of the page's")

    return handle


def _try_gate(host: str, port: int) -> None:
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }
    near = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104
    for headers in ({}, {**upgrade, "Origin": f"http://{client_name(near)}:{port}"}):
        connection = http.client.HTTPConnection(near, port, timeout=CHECK_S)
        try:
            connection.request("GET", "/", headers=headers)
            status: object = connection.getresponse().status
        except OSError as error:
            status = error
        finally:
            connection.close()
        if status != HTTPStatus.FORBIDDEN:
            raise UsageError(f"the view cannot protect its page ({status}); install the version of viser that vcmvsp requires")
