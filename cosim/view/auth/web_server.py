"""Who may see the page: every request and every connection must bring the token that was printed with the URL.

The web server is viser's, which lets everybody in. While it is made, what it serves with is put behind a gate: the token comes
with each request; the name that the page was dialled by must be ours (else a foreign name may have been bound to this machine),
and a page from elsewhere may not connect. Afterwards the gate is tried, lest a new viser goes round it.
It is plain HTTP: for other machines, put an SSH tunnel or a proxy with TLS before it.
"""

import asyncio
import contextlib
import http.client
import logging
import os
import socket
import warnings
from collections.abc import Awaitable, Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.view.auth.rules import MOST_PAGES, Gate, is_fit

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection

MOST_SOCKETS = 128  # that are open at a time: connections of pages, requests, and half-open ones
LARGEST = 1 << 20  # bytes of a message from a page
CHECK_S = 10.0

_logger = logging.getLogger(__name__)
_logger.addHandler(logging.NullHandler())
_logger.propagate = False  # what strangers send is no matter for the terminal


def open_server(host: str, port: int, token: str) -> "viser.ViserServer":
    """A web server that lets in those who bring the token.

    Args:
        host: what to listen on: 127.0.0.1, ::1, an address or name of this machine, or 0.0.0.0 or :: for all of them.
        port: 0: any that is free.
        token: not empty.

    Raises:
        UsageError: it cannot listen there, or the gate does not hold.
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
    """Let it listen no more."""
    with quiet():
        server.stop()


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep viser from talking to the terminal."""
    import rich

    said = rich.print
    rich.print = lambda *_, **__: None
    try:
        yield
    finally:
        rich.print = said


def _bound(host: str, port: int) -> socket.socket:
    """A socket that listens; viser would look for another port, and not say so."""
    if not 0 <= port < 1 << 16:
        raise UsageError(f"the view cannot listen on port {port}: ports go from 0, any that is free, to 65535")
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
        return socket.create_server(address[:2], family=family, backlog=MOST_SOCKETS)
    except OSError as error:
        reason = error.strerror if isinstance(error, socket.gaierror) or error.errno is None else os.strerror(error.errno)
        raise UsageError(f"the view cannot listen on {host}:{port}: {reason}; give another host or port") from error


def _connection() -> type["ServerConnection"]:
    """Connections of which there are not too many, and that take only what a page may send."""
    from websockets.asyncio.server import ServerConnection
    from websockets.protocol import State

    class Guarded(ServerConnection):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            brief = [each for each in self.server.handlers if each.state is not State.OPEN and not each.transport.is_closing()]
            if len(brief) > MOST_SOCKETS - MOST_PAGES:
                brief[0].transport.abort()  # the oldest: a request that is meant is answered long before its turn

        async def recv(self, decode: bool | None = None) -> Any:
            while True:
                message = await super().recv(decode)
                if is_fit(message):
                    return message
                await self.close(1003, "this is no message of the page's")

    return Guarded


def _calm(handler: Callable[..., Awaitable[None]]) -> Callable[..., Awaitable[None]]:
    """The handler of a connection, which ends with it whatever it brings."""

    async def handle(connection: "ServerConnection") -> None:
        try:
            await handler(connection)
        except Exception:
            _logger.debug("a connection has ended", exc_info=True)
            await connection.close(1003, "this is no message of the page's")

    return handle


def _try_gate(host: str, port: int) -> None:
    """Refuse to go on where a stranger is let in."""
    upgrade = {
        "Connection": "Upgrade",
        "Upgrade": "websocket",
        "Sec-WebSocket-Version": "13",
        "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    }
    near = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104
    name = f"[{near}]" if ":" in near else near
    for headers in ({}, {**upgrade, "Origin": f"http://{name}:{port}"}):
        connection = http.client.HTTPConnection(near, port, timeout=CHECK_S)
        try:
            connection.request("GET", "/", headers=headers)
            status: object = connection.getresponse().status
        except OSError as error:
            status = error
        finally:
            connection.close()
        if status != HTTPStatus.FORBIDDEN:
            raise UsageError(f"the view cannot be guarded ({status}); install the version of viser that vcmvsp was made with")
