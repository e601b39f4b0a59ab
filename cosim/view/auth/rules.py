"""Access rules of the page: which requests and messages pass, how others are refused, what browsers are told to keep to.

A browser loads ``entry.html``, which anybody may have, with status 403 if the URL has no token. It keeps the token in
``sessionStorage``, which each tab and port has to itself, loads viser's page with it, and offers it as a sub-protocol when that
page connects. Nothing is kept in a cookie: browsers send it to every other port of this machine.
"""

import hmac
import ipaddress
import secrets
import socket
import urllib.parse
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response


ENTRY = (Path(__file__).parent / "entry.html").read_text("utf-8")
PAGE = "/page"  # of viser
NO_TOKEN = "Open the URL that was printed, with its token.\n"  # noqa: S105  a sentence
MOST_PAGES = 32  # that are connected at a time
ANYWHERE = ("0.0.0.0", "::")  # noqa: S104  a word of the user's
LOOPBACK = ("127.0.0.1", "::1", "localhost")
ALLOWED = frozenset(
    {
        "CommandTriggerMessage",
        "GuiButtonHoldMessage",
        "GuiFormDirtyMessage",
        "GuiFormSubmitMessage",
        "GuiUpdateMessage",
        "SceneNodeClickMessage",
        "SceneNodeDragMessage",
        "ScenePointerMessage",
        "TransformControlsDragEndMessage",
        "TransformControlsDragStartMessage",
        "TransformControlsUpdateMessage",
        "ViewerCameraMessage",
    }
)
"""Messages that a page may send: those of viser's page that the control station uses. Not uploads, nor a public tunnel."""


def caution(host: str) -> str:
    """A line for those who let other machines see the page; empty: no other can."""
    return "" if host in LOOPBACK else f"{host}: whoever reads along on the network can see the page: it is plain HTTP\n"


def new_token() -> str:
    """A secret for a URL."""
    return secrets.token_urlsafe(24)


def url_of(host: str, port: int, token: str) -> str:
    """What a browser is given."""
    name = "localhost" if host in ANYWHERE else f"[{host}]" if ":" in host else host
    return f"http://{name}:{port}/?token={token}"


def is_fit(message: object) -> bool:
    """Whether a message of the page may be handed on."""
    if not isinstance(message, bytes):
        return False
    try:
        content = msgspec.msgpack.decode(message)
    except (ValueError, TypeError, RecursionError, msgspec.DecodeError):
        return False
    if not isinstance(content, dict) or not isinstance(kind := content.get("type"), str) or kind not in ALLOWED:
        return False
    if kind == "GuiUpdateMessage":  # anything else of a control would be set as well
        updates = content.get("updates")
        return isinstance(updates, dict) and updates.keys() == {"value"}
    return True


class Gate:
    """Decides who is let in.

    Args:
        host: that is listened on.
        port: likewise.
        token: what those who are let in bring.
        protocol: what their page speaks.
        page: its HTML.
    """

    def __init__(self, host: str, port: int, token: str, protocol: str, page: str) -> None:
        self.port, self._token, self._protocol, self._page = port, token.encode(), protocol, page
        self._names = {"127.0.0.1", "localhost", "::1", host.lower()}
        self._anywhere = host in ANYWHERE
        if self._anywhere:
            self._names.add(socket.gethostname().lower())

    def answer(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """What a request gets; None: it may open a connection."""
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
            return connection.respond(HTTPStatus.FORBIDDEN, "This page goes by another name: open the URL as it was printed.\n")
        own = {f"{scheme}://{hosts[0]}" for scheme in ("http", "https")}
        if not own.issuperset(origins) or len(origins) > 1 or (upgrade and not origins):
            return connection.respond(HTTPStatus.FORBIDDEN, "A page from elsewhere may not connect to this one.\n")
        if upgrade:
            return self._connecting(connection, headers)
        path = request.path.partition("?")[0]
        if path == "/":
            known = self._has_token("", *_tokens(request.path)[:1])
            return _html(connection, HTTPStatus.OK if known else HTTPStatus.FORBIDDEN, ENTRY.replace("NONCE", nonce))
        if not self._has_token("Bearer ", *headers.get_all("Authorization")):
            return connection.respond(HTTPStatus.FORBIDDEN, NO_TOKEN)
        if path != PAGE:
            return connection.respond(HTTPStatus.NOT_FOUND, "There is no such page.\n")
        return _html(connection, HTTPStatus.OK, self._page)

    def _connecting(self, connection: "ServerConnection", headers: "Headers") -> "Response | None":
        offered = [each.strip() for value in headers.get_all("Sec-WebSocket-Protocol") for each in value.split(",")]
        if not self._has_token("token.", *offered):
            return connection.respond(HTTPStatus.FORBIDDEN, NO_TOKEN)
        if self._protocol not in offered or headers.get_all("Upgrade") != ["websocket"]:
            return connection.respond(HTTPStatus.BAD_REQUEST, f"This page speaks {self._protocol}: load it again.\n")
        if len(connection.server.connections) >= MOST_PAGES:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_PAGES} pages are connected: close one.\n")
        return None

    def _is_ours(self, host: str) -> bool:
        """Whether a page that was dialled by this name, and port, is this one."""
        try:
            parts = urllib.parse.urlsplit(f"//{host}")
            name, port = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if parts.netloc != host or parts.username is not None or port != self.port:  # a name and a port, and nothing else
            return False
        return name in self._names or (self._anywhere and _is_address(name))  # no name can be bound to where it is none

    def _has_token(self, scheme: str, *given: str) -> bool:
        tokens = (each.removeprefix(scheme) for each in given if each.startswith(scheme))
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
        response.headers["Cache-Control"] = "no-store"
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["X-Frame-Options"] = "DENY"
        response.headers["Referrer-Policy"] = "no-referrer"
        response.headers["Cross-Origin-Resource-Policy"] = "same-origin"


def _html(connection: "ServerConnection", status: HTTPStatus, text: str) -> "Response":
    response = connection.respond(status, text)
    response.headers.pop("Content-Type", None)
    response.headers["Content-Type"] = "text/html; charset=utf-8"
    return response


def _tokens(path: str) -> list[str]:
    try:
        return urllib.parse.parse_qs(urllib.parse.urlsplit(path).query).get("token", [])
    except ValueError:
        return []


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
