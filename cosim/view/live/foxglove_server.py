"""Live stream of a recording to Foxglove: every message of ``run.mcap`` when it is written, in the same bytes.

foxglove-sdk serves the protocol ``foxglove.sdk.v1`` (https://github.com/foxglove/ws-protocol); it is an extra: ``pip install
'vcmvsp[foxglove]'``. Clients only read: the server offers no capability but the simulated time. A client that subscribes gets
the newest message of the topic at once, since some topics, e.g. ``world/solids``, have one message in a run. The messages of a
client that reads too slowly are dropped; the run never waits. The SDK (0.30) advertises a channel some microseconds before it
knows it: a client that subscribes faster is told "Unknown channel ID", and has to subscribe again.

The SDK's server knows no token, host name or origin, unlike the control station (`cosim.view.web_server`): every program that
reaches the port can read, and so can every page that is open in a browser of this machine.
"""

import logging
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.recording.mcap_writer import Schema
from vcmvsp.cosim.view import FOXGLOVE_PORT, HOST
from vcmvsp.cosim.view.web_server import LOOPBACK, client_name

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView, Client

_logger = logging.getLogger("foxglove")


class FoxgloveServer:
    """A WebSocket server for Foxglove and Lichtblick, a context manager (`cosim.recording.mcap_writer.MessageSink`).

    Args:
        host: address to listen on.
        port: TCP port; 0: any free port.
        opened: receives the URL for a client.

    Raises:
        UsageError: foxglove-sdk is not installed, or the address cannot be used.
    """

    def __init__(self, host: str = HOST, port: int = FOXGLOVE_PORT, opened: Callable[[str], None] = lambda _: None) -> None:
        try:
            import foxglove
            from foxglove.websocket import Capability
        except ImportError as error:
            raise UsageError("--foxglove needs foxglove-sdk: pip install 'vcmvsp[foxglove]'") from error
        _logger.setLevel(logging.CRITICAL)  # dropped messages of slow clients do not belong on the terminal
        self._new_channel, self._new_schema, self._context = foxglove.Channel, foxglove.Schema, foxglove.Context()
        self._channels: dict[int, Channel] = {}  # by the recording's numbers
        self._numbers: dict[int, int] = {}  # the recording's numbers, by the server's
        self._newest: dict[int, tuple[int, bytes]] = {}  # time (ns) and message, by the recording's numbers
        self._now_ns = -1
        try:
            self._server = foxglove.start_server(
                name="vcmvsp",
                host=host,
                port=port,
                capabilities=[Capability.Time],
                server_listener=self,
                context=self._context,
            )
        except (OSError, RuntimeError, OverflowError) as error:
            raise UsageError(
                f"the Foxglove server cannot listen on {host}:{port}: {error}; choose another --foxglove port"
            ) from error
        self.port = self._server.port
        self.url = f"ws://{client_name(host)}:{self.port}"
        opened(self.url)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()

    def add_channel(self, number: int, topic: str, encoding: str, schema: Schema) -> None:
        """Advertise a channel of the recording."""
        described = self._new_schema(name=schema.name, encoding=schema.encoding, data=schema.text)
        channel = self._new_channel(topic, schema=described, message_encoding=encoding, context=self._context)
        self._channels[number], self._numbers[channel.id()] = channel, number

    def put(self, number: int, time_ns: int, message: bytes) -> None:
        """Send a message of a channel to its subscribers."""
        if time_ns != self._now_ns:
            self._now_ns = time_ns
            self._server.broadcast_time(time_ns)
        self._newest[number] = time_ns, message
        self._channels[number].log(message, log_time=time_ns)

    def close(self) -> None:
        """Disconnect the clients and stop listening. Repeated calls are allowed."""
        self._server.stop()

    def on_subscribe(self, client: "Client", channel: "ChannelView") -> None:
        """Send the newest message again, to all subscribers of the topic: the SDK has no address of one of them."""
        number = self._numbers.get(channel.id)
        if number is not None and (newest := self._newest.get(number)) is not None:
            self._channels[number].log(newest[1], log_time=newest[0])

    def __getattr__(self, name: str) -> Any:
        """The listener's other callbacks do nothing."""
        if name.startswith("on_"):
            return lambda *_: None
        raise AttributeError(name)


def caution(host: str) -> str:
    """Warning for a stream that is visible to other machines; empty if it is not."""
    return (
        "" if host in LOOPBACK else f"{host}: anyone on the network can read the stream: it has neither token nor encryption\n"
    )
