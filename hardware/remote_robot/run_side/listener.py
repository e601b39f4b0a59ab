"""Zenoh session of the run: listens, takes requests of robots, exchanges messages with one of them.

Zenoh calls back in its own threads; callbacks only pass on.
"""

import contextlib
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport import access_control, key_names
from vcmvsp.cosim.transport.zenoh_session import opened
from vcmvsp.cosim.util.codec import encode
from vcmvsp.hardware.drivers.base import PortError
from vcmvsp.hardware.remote_robot.messages import RobotWelcome

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys


class Peer(NamedTuple):
    """Sender of a message, from its key: authentic if there are certificates."""

    name: str  # of the machine, as in its certificate
    session: str


class RobotGreeting(NamedTuple):
    """Request of a robot."""

    name: str
    payload: bytes
    answer: Callable[[RobotWelcome], None]


class RobotMessage(NamedTuple):
    """A message of a robot."""

    peer: Peer
    data: bytes
    arrived_ns: int


class LinkEnded(NamedTuple):
    """The link of a robot ended."""

    peer: Peer


News = RobotGreeting | RobotMessage | LinkEnded


class RobotListener:
    """Listens for the robot of one vehicle; ``take`` gets news, in Zenoh's threads. `PortError`: the endpoint is not free."""

    def __init__(self, listen: str, keys: "Keys | None", vehicle: str, take: Callable[[News], None]) -> None:
        self._vehicle, self._take = vehicle, take
        self._publisher: zenoh.Publisher | None = None
        self._subscriber: Any = None
        if keys is not None:
            zenoh.init_log_from_env_or(access_control.LOG)
        secure = access_control.ROBOT_LIMITS if keys is None else access_control.driver_security(keys, vehicle)
        try:
            self._session = opened({"mode": "router", "listen": {"endpoints": [listen]}}, secure, "Zenoh")
        except UsageError as error:
            happened = str(error).removeprefix("Zenoh: ")
            advice = "check that no other run uses this port, and give each vehicle its own port"
            raise PortError(listen, f"cannot listen there ({happened})", advice) from None
        alive, watch = f"vcmvsp/robot/*/{vehicle}/*/alive", Callback(self._on_token, indirect=False)
        self._references: list[Any] = [
            self._session.liveliness().declare_subscriber(alive, watch),
            self._session.declare_queryable(key_names.GREET, Callback(self._on_greeting, indirect=False)),
            self._session.liveliness().declare_token(key_names.HUB_ALIVE),
        ]

    def follow(self, peer: Peer) -> None:
        """Exchange messages with this robot from now on; raises `ValueError` for an invalid name."""
        up, down = (key_names.robot_key(peer.name, self._vehicle, peer.session, each) for each in ("up", "down"))
        self.leave()
        self._subscriber = self._session.declare_subscriber(up, Callback(self._on_sample, indirect=False))
        drop = zenoh.CongestionControl.DROP  # a robot that does not listen must not block
        self._publisher = self._session.declare_publisher(down, congestion_control=drop, express=True)

    def leave(self) -> None:
        """Follow no robot."""
        for each in (self._subscriber, self._publisher):
            if each is not None:
                with contextlib.suppress(zenoh.ZError):
                    each.undeclare()
        self._subscriber = self._publisher = None

    def say(self, data: bytes) -> None:
        """Send to the followed robot."""
        if self._publisher is not None:
            self._publisher.put(data)

    def close(self) -> None:
        """End the session; robots see that. Never raises."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()  # type: ignore[no-untyped-call]

    def _on_greeting(self, query: zenoh.Query) -> None:
        speaker = key_names.robot_speaker(str(query.key_expr))
        payload = query.payload.to_bytes() if query.payload else b""
        if speaker is None or len(payload) > access_control.MAX_ROBOT:
            return

        def answer(welcome: RobotWelcome) -> None:
            with contextlib.suppress(zenoh.ZError), query:  # the robot may have ended
                query.reply(query.key_expr, encode(welcome))

        self._take(RobotGreeting(speaker[0], payload, answer))

    def _on_sample(self, sample: zenoh.Sample) -> None:
        arrived_ns = time.monotonic_ns()
        peer = self._peer(sample.key_expr)
        if peer is not None and sample.kind == zenoh.SampleKind.PUT and len(sample.payload) <= access_control.MAX_ROBOT:
            self._take(RobotMessage(peer, sample.payload.to_bytes(), arrived_ns))

    def _on_token(self, sample: zenoh.Sample) -> None:
        peer = self._peer(sample.key_expr)
        if peer is not None and sample.kind == zenoh.SampleKind.DELETE:
            self._take(LinkEnded(peer))

    def _peer(self, key: zenoh.KeyExpr) -> Peer | None:
        """Sender of a message; None for another vehicle, or a key with wildcards."""
        speaker = key_names.robot_speaker(str(key))
        return Peer(speaker[0], speaker[2]) if speaker is not None and speaker[1] == self._vehicle else None
