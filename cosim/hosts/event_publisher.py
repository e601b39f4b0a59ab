"""Events of a run for observers: every event as JSON under its key, and a description of the run on request.

The wire format is described in ``README.md`` beside this file. Nothing here can change a run: an event without a subscriber
costs a dictionary look-up, and samples that a slow observer does not take are dropped.
"""

import contextlib
import struct
import time
from base64 import b64encode
from collections.abc import Callable, Mapping
from importlib import metadata
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.transport import key_names
from vcmvsp.cosim.transport.zenoh_session import undeclare
from vcmvsp.cosim.types import (
    AnyValue,
    Array,
    Image,
    Later,
    Mosaic,
    ProbabilityMap,
    Reception,
    Receptions,
    States,
    Value,
    VehicleState,
)

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys

ECHO = b"echo"
"""Key of the question that the hub also answers on a topic: ``echo/NAME``."""

stamp = struct.Struct("<Q")
"""The attachment of a sample: simulated time, ns."""


class You(msgspec.Struct, frozen=True):
    """The run's view of the machine that sent the query."""

    name: str
    role: str | None = None  # "host" or "observer"; None: the run uses no certificates
    vehicles: tuple[str, ...] = ()  # vehicles of the certificate


class About(msgspec.Struct, frozen=True, kw_only=True):
    """Description of a run: the answer to ``vcmvsp/about/NAME``."""

    version: str  # of vcmvsp
    protocol: int
    scenario: str = ""
    seed: int | None = None
    duration_s: float | None = None
    vehicles: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()  # vehicles whose agents have not joined, or are lost
    time_ns: int | None = None  # simulated; None: the run has not begun
    wall_ns: int  # the hub's wall clock when it answered, since 1970
    you: You


class Topics:
    """Publishes events on the hub's session; a kernel observer like the recorder.

    Args:
        about: ``scenario``, ``seed``, ``duration_s``, ``vehicles`` and ``missing`` of `About`. A callable is called at each
            answer, in a thread of Zenoh's.
        keys: certificates of the admitted machines, for `You`.
    """

    def __init__(self, session: zenoh.Session, about: Mapping[str, Any], keys: "Keys | None" = None) -> None:
        self.session, self._about, self._keys = session, about, keys
        self._version = metadata.version("vcmvsp")
        self._now_ns: int | None = None
        self._has_subscribers = _HasSubscribers(self._declare)
        self._publishers: dict[str, zenoh.Publisher] = {}
        self._each: tuple[tuple[str, ...], tuple[str, ...]] = (), ()  # vehicles, and the keys of their states
        self._queryable = session.declare_queryable(key_names.ABOUT, Callback(self._on_question, indirect=False))

    def on(self, event: Event) -> None:
        """Publish an event at its own time."""
        self._now_ns = event.time_ns
        if type(event.value) is Receptions:
            self._on_receptions(event.time_ns, event.value)
            return
        if self._has_subscribers[event.key]:
            self._publish(event.key, event.time_ns, event.value)
        if type(event.value) is States:
            self._on_states(event.time_ns, event.value)

    def close(self) -> None:
        """Stop publishing."""
        undeclare(self._queryable, *self._publishers.values())

    def _declare(self, key: str) -> None:
        def on_matching(status: zenoh.MatchingStatus) -> None:
            self._has_subscribers[key] = status.matching

        if set(key).isdisjoint("*$?#"):  # keys of user-defined events may contain reserved characters
            with contextlib.suppress(zenoh.ZError):
                publisher = self.session.declare_publisher(
                    key_names.TOPIC + key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA_LOW
                )
                self._publishers[key] = publisher
                publisher.declare_matching_listener(Callback(on_matching, indirect=False))

    def _on_states(self, time_ns: int, states: States) -> None:
        """Publish the state of each vehicle under its own key, as in the recording."""
        if self._each[0] != states.names:
            self._each = states.names, tuple(f"{name}/state" for name in states.names)
        rows = [row for row, key in enumerate(self._each[1]) if self._has_subscribers[key]]
        if rows:
            columns = states.position, states.velocity, states.attitude, states.angular_velocity
            for row, p, v, q, w in zip(rows, *(column[rows].tolist() for column in columns), strict=True):
                state = VehicleState(position=p, velocity=v, attitude=q, angular_velocity=w)
                self._publish(self._each[1][row], time_ns, state)

    def _on_receptions(self, time_ns: int, batch: Receptions) -> None:
        """Publish each reception under its receiver's own key, when it is decided; it may arrive later."""
        keys = {row: f"{batch.names[row]}/heard" for row in np.flatnonzero(np.bincount(batch.receiver)).tolist()}
        rows = {row for row, key in keys.items() if self._has_subscribers[key]}
        if not rows:
            return
        sent_ns, columns = batch.sent_ns.tolist(), (batch.message, batch.receiver, batch.arrival_ns, batch.rssi_dbm)
        for number, row, received_ns, rssi_dbm in zip(*(each.tolist() for each in columns), strict=True):
            if row in rows:
                times = {"sent_ns": sent_ns[number], "received_ns": received_ns}
                self._publish(keys[row], time_ns, Reception(message=batch.messages[number], rssi_dbm=rssi_dbm, **times))

    def _publish(self, key: str, time_ns: int, value: AnyValue) -> None:
        tag, payload = _encoded(value)
        self._publishers[key].put(payload, encoding=f"application/json;{tag}", attachment=stamp.pack(time_ns))

    def _on_question(self, query: zenoh.Query) -> None:
        speaker = key_names.speaker(str(query.key_expr))
        with query:
            if speaker is not None:
                query.reply(query.key_expr, msgspec.json.encode(self._answer(speaker[0])), encoding="application/json;about")
                if query.payload is not None and query.payload.to_bytes() == ECHO:
                    self.session.put(
                        f"{key_names.TOPIC}echo/{speaker[0]}",
                        b'{"type":"echo"}',
                        encoding="application/json;echo",
                        attachment=stamp.pack(self._now_ns or 0),
                        congestion_control=zenoh.CongestionControl.DROP,
                    )

    def _answer(self, name: str) -> dict[str, Any]:
        entry = None if self._keys is None else self._keys.index.find(name)
        facts = {key: value() for key, value in self._about.items() if callable(value)}
        you = You(name) if entry is None else You(name, entry.role, entry.vehicles)
        now = {"time_ns": self._now_ns, "wall_ns": time.time_ns(), "you": you}
        return {**self._about, **facts, "version": self._version, "protocol": protocol.PROTOCOL, **now}


class _HasSubscribers(dict[str, bool]):
    """Whether each topic has subscribers; a topic is declared when its key first appears."""

    def __init__(self, declare: Callable[[str], None]) -> None:
        self._declare = declare

    def __missing__(self, key: str) -> bool:
        self[key] = False
        self._declare(key)
        return self[key]


def _encoded(value: Value | Later) -> tuple[str, bytes]:
    """Tag and JSON of a value; a value that cannot be encoded does not end the run."""
    try:
        if isinstance(value, Later):
            value = value.get()
        tag = str(type(value).__struct_config__.tag)
        return tag, _encode({"type": tag, **_picture(value)} if isinstance(value, Image | ProbabilityMap | Mosaic) else value)
    except Exception as error:
        return "error", _encode({"type": "error", "message": f"{type(error).__name__}: {error}"})


def _picture(value: Image | ProbabilityMap | Mosaic) -> dict[str, Any]:
    """An image or map as JSON: arrays as base64 of their bytes (README.md)."""
    if isinstance(value, Image):
        height, width, _ = value.pixels.shape
        depth_m = None if value.depth_m is None else _base64(value.depth_m.astype("<f4", copy=False))
        own = {"width": width, "height": height, "pixels": _base64(value.pixels)}
        return own | {"time_ns": value.time_ns, "focal_px": value.focal_px, "depth_m": depth_m}
    arrays = {"pixels": value.pixels} if isinstance(value, Mosaic) else {"probability": value.probability, "seen": value.seen}
    rows, columns = next(iter(arrays.values())).shape[:2]
    grid = {"left": value.left, "bottom": value.bottom, "cell_m": value.cell_m, "columns": columns, "rows": rows}
    return grid | {name: _base64(array) for name, array in arrays.items()}


def _base64(array: Array) -> str:
    return b64encode(array.tobytes()).decode()


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"a {type(value).__name__} cannot be shown")


_encode = msgspec.json.Encoder(enc_hook=_plain).encode
