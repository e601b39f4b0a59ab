"""The author's side: an `Agent` sees an `Observation`, may use its `Radio`, and returns a command.

The same class runs in the simulation, in another process, on another machine and on a robot: it imports only ``cosim``
and has no clock, no thread and no socket.
"""

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from cosim.clock import Ticks
from cosim.rng import stream
from cosim.types import Follows, Message, OnLost, Reading, Reception, Value, VehicleState, Velocity, Waypoint

LARGEST_MESSAGE_BYTES = 2**31 - 1
DEEPEST = 64  # lists and mappings inside one another in a message; Python gives up below 1000, depending on who calls


class Observation(Value, frozen=True, kw_only=True):
    """All that an agent may know at a tick: never the truth of others."""

    vehicle: str
    time_ns: int
    state: VehicleState  # its own, as its pose source tells it
    readings: dict[str, Reading]  # the newest of each sensor, by name: "odometry", and those of its vehicle
    heard: tuple[Reception, ...]  # since the last tick, oldest first

    @property
    def time_s(self) -> float:
        """Simulated seconds since the start."""
        return self.time_ns / 1e9


class VehicleInfo(Value, frozen=True, kw_only=True):
    """What an agent is told once, before its first tick."""

    name: str
    vehicles: tuple[str, ...]
    period_s: float
    latency_s: float
    seed: int

    def stream(self, name: str) -> np.random.Generator:
        """A random generator that is this agent's own, e.g. ``info.stream("explore")``."""
        return stream(self.seed, f"{self.name}/agent/{name}")


class AgentSpec(Value, frozen=True, kw_only=True):
    """What a scenario says of one vehicle's agent: all that a host needs to build it, here or elsewhere."""

    vehicle: str
    kind: str  # short name, "module:Class" or "file.py:Class"
    folder: str  # where a relative file is looked for
    params: dict[str, Any]  # the vehicle's own parameters
    defaults: dict[str, Any]  # [agents]: for each agent that takes the parameter
    period_s: float | None  # None: the class's own period
    latency_s: float
    source: str  # the scenario file, for error messages
    sensors: tuple[str, ...] = ()  # what the vehicle carries, by name
    fails_s: float | None = None  # from then on it is dead
    on_lost: OnLost = "stop"  # what becomes of the run, or of the vehicle, when the agent fails or its host is lost
    hold_s: float = 0.0  # for so long its last command counts then


class AgentInfo(Value, frozen=True, kw_only=True):
    """What a host says of an agent that it has built."""

    vehicle: str
    agent: str  # its kind, for messages
    ticks: Ticks
    latency_ns: int
    params: dict[str, Any]  # every parameter, defaults included, as far as TOML can say it
    known: tuple[str, ...]  # the names of all its parameters
    taken: tuple[str, ...]  # the [agents] defaults that it takes
    sensors: tuple[str, ...] = ()  # what it says that it looks at


class Radio:
    """The agent's own transmitter: what is sent here enters the emulated channel when the tick ends."""

    def __init__(self, vehicle: str, vehicles: tuple[str, ...]) -> None:
        self._vehicle, self._vehicles = vehicle, frozenset(vehicles)
        self._outbox: list[Message] = []

    def send(
        self,
        body: Mapping[str, Any] | bytes | None = None,
        /,
        *,
        to: str | None = None,
        size_bytes: int | None = None,
        priority: int = 0,
        **values: Any,
    ) -> None:
        """Send a message to all who can hear it, or to one vehicle.

        Args:
            body: a small mapping or bytes; keywords are added to the mapping, so that ``radio.send(x=1.0)`` works.
            to: name of the only vehicle meant; None broadcasts.
            size_bytes: payload size that the channel reckons with; default: the encoded size of the body.
            priority: one of a higher priority overtakes those that wait in this radio's queue (macs ``dcf``, ``csma154``).
        """
        if to is not None and (to not in self._vehicles or to == self._vehicle):
            raise ValueError(f"radio.send(to={to!r}): not another vehicle of this run ({', '.join(sorted(self._vehicles))})")
        if isinstance(body, bytes):
            if values:
                raise TypeError("radio.send(): give either bytes or named values, not both")
            content: dict[str, Any] | bytes = bytes(body)
            natural = len(body)
        else:
            encoded = msgspec.msgpack.encode({**(body or {}), **values}, enc_hook=_plain)
            content = msgspec.msgpack.decode(encoded, type=dict[str, Any])  # what receivers get, here or over a wire
            check_body(content)
            natural = len(encoded)
        size = natural if size_bytes is None else int(size_bytes)
        if not 0 <= size <= LARGEST_MESSAGE_BYTES:
            raise ValueError(f"radio.send(size_bytes={size}): must be from 0 to {LARGEST_MESSAGE_BYTES}")
        self._outbox.append(Message(sender=self._vehicle, body=content, size_bytes=size, to=to, priority=int(priority)))

    def drain(self) -> list[Message]:
        """Take what was sent since the last call (for the host of the agent)."""
        outbox, self._outbox = self._outbox, []
        return outbox


class Agent:
    """Base class of algorithms: one object per vehicle, stepped every ``period`` seconds.

    Constructor parameters come from the vehicle's ``agent`` table in the scenario; annotate them, and the scenario's
    values are checked against the annotations.
    """

    period: float = 0.1  # s; a scenario's agents.period_s wins
    sensors: tuple[str, ...] | None = None  # whose readings it looks at, by name; None: all. Others are not sent to its host
    follows: Follows | None = None  # set it to have the formation error of this vehicle measured
    _notes: dict[str, float | str | bool] | None = None

    def start(self, info: VehicleInfo) -> None:
        """Called once before the first tick."""

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """Decide at a tick; the command holds until the next one. None leaves the last command in force."""
        raise NotImplementedError

    def close(self) -> None:
        """Called once at the end of the run."""

    def note(self, **values: float | str | bool) -> None:
        """Have values of this tick recorded under ``<vehicle>/note``, e.g. ``self.note(age_s=0.1, status="waiting")``."""
        if self._notes is None:
            self._notes = {}
        for name, value in values.items():
            self._notes[name] = (
                value.encode().decode()
                if isinstance(value, str)
                else value
                if value is True or value is False
                else float(value)
            )

    def drain_notes(self) -> dict[str, float | str | bool]:
        """Take what was noted since the last call (for the host of the agent)."""
        notes, self._notes = self._notes, None
        return notes or {}


def check_body(body: Mapping[str, Any]) -> None:
    """Raise a `ValueError` or a `TypeError` if the recording could not hold this body of a message."""
    text = msgspec.json.encode(body)
    # No deeper than it has brackets; texts may have some, too, so that the count alone is not enough to refuse it.
    if text.count(b"{") + text.count(b"[") > DEEPEST and _depth(body) > DEEPEST:
        raise ValueError(f"a message may have {DEEPEST} lists and mappings inside one another, not {_depth(body)}")


def _depth(value: Any) -> int:
    """How many lists and mappings are inside one another, at most."""
    depth, level = 0, [value]
    while level := [each for each in level if isinstance(each, dict | list)]:
        depth += 1
        level = [inner for each in level for inner in (each.values() if isinstance(each, dict) else each)]
    return depth


def _plain(value: Any) -> Any:
    """NumPy numbers and arrays in a message body become plain ones."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"radio.send(): cannot send a {type(value).__name__}; use numbers, strings, bytes, lists and mappings")
