"""Interface for authors of agents: an `Agent` gets an `Observation`, may use its `Radio`, and returns a command.

The same class runs in the simulation, in another process, on another machine and on a robot: it imports only ``cosim``
and has no clock, no thread and no socket.
"""

import functools
import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.received import ReceivedMessages
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import (
    Follows,
    Message,
    Mosaic,
    OnLost,
    ProbabilityMap,
    Reading,
    Sightings,
    Value,
    VehicleState,
    Velocity,
    Waypoint,
)

Shown = ProbabilityMap | Sightings | Mosaic
SHOWN: Mapping[type[Shown], str] = {ProbabilityMap: "map", Sightings: "sightings", Mosaic: "mosaic"}
CELLS = ("probability", "seen", "pixels")  # arrays of shown values
FURTHEST_M = 1e9  # largest coordinate

LARGEST_MESSAGE_BYTES = 2**31 - 1
DEEPEST = 64  # nesting of lists and mappings in a message; Python's recursion limit is below 1000, minus the caller's depth


class Observation(Value, frozen=True, kw_only=True):
    """What an agent observes at a tick; it never contains the true states of other vehicles."""

    vehicle: str  # the vehicle's own name
    time_ns: int  # simulated time since the start
    state: VehicleState  # the vehicle's own state as estimated by its pose source
    readings: dict[str, Reading]  # newest reading of each sensor, by name: "odometry", and the vehicle's sensors
    heard: ReceivedMessages = msgspec.field(default_factory=lambda: ReceivedMessages.none(0))  # since the last tick
    own_time_ns: int | None = None  # by the vehicle's own clock; None: it has the time of the run

    def __post_init__(self) -> None:
        if not isinstance(self.heard, ReceivedMessages):  # a plain list, in a test of an agent
            msgspec.structs.force_setattr(self, "heard", ReceivedMessages.of(self.heard, self.clock_ns))

    @property
    def time_s(self) -> float:
        """Simulated seconds since the start."""
        return self.time_ns / 1e9

    @property
    def clock_ns(self) -> int:
        """Time by the vehicle's own clock, which its readings and the stamps of its radio have."""
        return self.time_ns if self.own_time_ns is None else self.own_time_ns

    @property
    def clock_s(self) -> float:
        """Seconds by the vehicle's own clock."""
        return self.clock_ns / 1e9


class Body(Value, frozen=True, kw_only=True):
    """Size and mobility of a vehicle."""

    width_m: float  # width across the direction of travel
    radius_m: float  # radius of the circle around the reference point that contains the vehicle
    flies: bool = False  # commands are in the world frame, and it can move sideways


class VehicleInfo(Value, frozen=True, kw_only=True):
    """Information for an agent before its first tick."""

    name: str  # of its vehicle
    vehicles: tuple[str, ...]  # names of all vehicles of the run
    period_s: float  # time between two ticks
    latency_s: float  # time from an observation to the effect of commands and messages
    seed: int  # of the run; draw from `stream`
    body: Body | None = None  # width_m, radius_m and flies; None: unknown
    sensors: tuple[str, ...] | None = None  # names of the vehicle's sensors; None: unknown
    beside_m: Mapping[str, float] = msgspec.field(default_factory=dict)  # horizontal offset of sensors, m, unless 0

    def stream(self, name: str) -> np.random.Generator:
        """A random generator of this agent's own, e.g. ``info.stream("explore")``."""
        return stream(self.seed, f"{self.name}/agent/{name}")


class AgentSpec(Value, frozen=True, kw_only=True):
    """Specification of one vehicle's agent: all that a host needs to build it."""

    vehicle: str
    kind: str  # short name, "module:Class" or "file.py:Class"
    folder: str  # folder of a relative file in ``kind``
    params: dict[str, Any]  # the vehicle's own parameters
    defaults: dict[str, Any]  # [agents]: default parameters for each agent that has them
    replaced: dict[str, tuple[str, ...]] = msgspec.field(default_factory=dict)  # keys set in tables of a replaced kind
    period_s: float | None  # None: the class's own period
    latency_s: float
    source: str  # the scenario file, for error messages
    sensors: tuple[str, ...] = ()  # names of the vehicle's sensors
    beside_m: Mapping[str, float] = msgspec.field(default_factory=dict)  # horizontal offset of sensors, m, unless 0
    body: Body | None = None
    battery: bool = False  # whether the vehicle has a battery; the agent fails when it is empty
    fails_s: float | None = None  # time from which the agent is dead
    on_lost: OnLost = "stop"  # reaction of the run or the vehicle to a failed agent or a lost host
    hold_s: float = 0.0  # how long the last command holds then


class AgentInfo(Value, frozen=True, kw_only=True):
    """A host's description of an agent that it has built."""

    vehicle: str
    agent: str  # kind of the agent, for messages
    ticks: Ticks
    latency_ns: int
    params: dict[str, Any]  # every parameter, defaults included, if TOML can express it
    known: tuple[str, ...]  # names of all parameters
    taken: tuple[str, ...]  # [agents] defaults that the agent has
    sensors: tuple[str, ...] = ()  # sensors that the agent reads
    files: tuple[str, ...] = ()  # file names in its parameters, as written


@functools.lru_cache(maxsize=1)
def _name_set(names: tuple[str, ...]) -> frozenset[str]:
    """One shared set of names for all agents of a run: separate sets would take quadratic memory."""
    return frozenset(names)


class Radio:
    """The agent's transmitter: messages sent here enter the emulated channel when the tick ends.

    Of several radios it is the vehicle's first one; ``radio["lora"]`` is the one of that name.
    """

    def __init__(self, vehicle: str, vehicles: tuple[str, ...], radios: Mapping[str, tuple[str, ...]] | None = None) -> None:
        self._vehicle, self._vehicles = vehicle, _name_set(vehicles)
        self._name: str | msgspec.UnsetType = msgspec.UNSET
        self._outbox: list[Message] = []
        self._radios: dict[str, Radio] = {}  # those of several that the vehicle has
        self._is_absent = bool(radios)
        for name, members in (radios or {}).items():
            if vehicle in members:
                own = self._radios[name] = Radio(vehicle, members)
                own._name, own._outbox = name, self._outbox
                if self._is_absent:
                    self._name, self._vehicles, self._is_absent = name, own._vehicles, False

    def __getitem__(self, name: str) -> "Radio":
        """The vehicle's radio of a name."""
        if name not in self._radios:
            raise KeyError(f"radio[{name!r}]: the radios of {self._vehicle} are {', '.join(self._radios) or 'without names'}")
        return self._radios[name]

    def send(
        self,
        body: Mapping[str, Any] | bytes | None = None,
        /,
        *,
        to: str | None = None,
        size_bytes: int | None = None,
        priority: int = 0,
        **values: object,
    ) -> int:
        """Broadcast a message, or send it to one vehicle; returns its payload size in bytes.

        Args:
            body: a small mapping or bytes; keywords are added to the mapping, so that ``radio.send(x=1.0)`` works.
            to: name of the only receiver; None broadcasts.
            size_bytes: payload size for the channel; default: the encoded size of the body.
            priority: a message of higher priority overtakes others in this radio's queue (macs ``dcf``, ``csma154``).
        """
        if self._is_absent:
            raise ValueError(f"radio.send(): {self._vehicle} has no radio")
        if to is not None and (to not in self._vehicles or to == self._vehicle):
            raise ValueError(f"radio.send(to={to!r}): unknown receiver; other vehicles: {', '.join(sorted(self._vehicles))}")
        if isinstance(body, bytes):
            if values:
                raise TypeError("radio.send(): pass either bytes or named values, not both")
            content: dict[str, Any] | bytes = bytes(body)
            natural = len(body)
        else:
            encoded = msgspec.msgpack.encode({**(body or {}), **values}, enc_hook=_plain)
            content = msgspec.msgpack.decode(encoded, type=dict[str, Any])  # the body as receivers get it, local or remote
            check_body(content)
            natural = len(encoded)
        size = natural if size_bytes is None else int(size_bytes)
        if not 0 <= size <= LARGEST_MESSAGE_BYTES:
            raise ValueError(f"radio.send(size_bytes={size}): must be from 0 to {LARGEST_MESSAGE_BYTES}")
        message = Message(sender=self._vehicle, body=content, size_bytes=size, to=to, priority=int(priority), radio=self._name)
        self._outbox.append(message)
        return size

    def drain(self) -> list[Message]:
        """Take the messages sent since the last call (for the host of the agent)."""
        outbox = self._outbox.copy()
        self._outbox.clear()  # the radios of a vehicle share it
        return outbox


class Agent:
    """Base class of algorithms: one object per vehicle, stepped every ``period`` seconds.

    Constructor parameters come from the vehicle's ``agent`` table in the scenario; annotate them, and the scenario's
    values are checked against the annotations.
    """

    period: float = 0.1  # s; a scenario's agents.period_s wins
    sensors: tuple[str, ...] | None = None  # sensors that it reads; None: all. Other readings are not sent to its host
    follows: Follows | None = None  # set it to measure the formation error of this vehicle
    _notes: dict[str, float | str | bool] | None = None
    _shown: dict[str, Shown] | None = None

    def start(self, info: VehicleInfo) -> None:
        """Prepare the agent; called once before the first tick."""

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """Choose the command of a tick; it holds until the next one. None keeps the last command."""
        raise NotImplementedError

    def close(self) -> None:
        """Release resources; called once at the end of the run."""

    def note(self, **values: float | str | bool) -> None:
        """Record values of this tick under ``<vehicle>/note``, e.g. ``self.note(age_s=0.1, status="waiting")``."""
        if self._notes is None:
            self._notes = {}
        for name, value in values.items():
            if type(value) is float or value is True or value is False:  # the common case
                self._notes[name] = value
            else:
                self._notes[name] = value.encode().decode() if isinstance(value, str) else float(value)

    def show(self, value: Shown) -> None:
        """Record a map, sightings or a mosaic of this tick under ``<vehicle>/map``, ``/sightings`` or ``/mosaic``.

        The value is copied: its arrays may change afterwards.

        Raises:
            TypeError: the value is of another type.
            ValueError: numbers that are not finite, arrays of another shape or type.
        """
        if type(value) not in SHOWN:
            raise TypeError(f"show({type(value).__name__}): only a ProbabilityMap, Sightings or a Mosaic can be shown")
        try:
            plain = _copied(value)
        except (TypeError, ValueError) as error:
            raise ValueError(f"show({type(value).__name__}): {error}") from None
        if problem := unfit(plain):
            raise ValueError(f"show({type(value).__name__}) with {problem}")
        if self._shown is None:
            self._shown = {}
        self._shown[SHOWN[type(plain)]] = plain

    def drain_shown(self) -> dict[str, Shown]:
        """Take the values shown since the last call, by key (for the host of the agent)."""
        values, self._shown = self._shown, None
        return values or {}

    def drain_notes(self) -> dict[str, float | str | bool]:
        """Take the values noted since the last call (for the host of the agent)."""
        notes, self._notes = self._notes, None
        return notes or {}


class DrivenVehicle(Agent):
    """A vehicle that the caller of `vcmvsp.start` drives: it has no algorithm, and a radio for messages between two steps."""

    radio: Radio

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """Refuse: only a run that its caller steps has such a vehicle."""
        raise TypeError("a DrivenVehicle has no algorithm: vcmvsp.start() runs it")


def _copied(value: Shown) -> Shown:
    """A copy with plain numbers and its own arrays, as received from a host."""
    if isinstance(value, Sightings):
        return msgspec.msgpack.decode(msgspec.msgpack.encode(value, enc_hook=_item), type=Sightings)
    arrays = {name: np.array(getattr(value, name), order="C") for name in CELLS if hasattr(value, name)}
    for each in arrays.values():
        each.flags.writeable = False
    place = {name: float(getattr(value, name)) for name in ("left", "bottom", "cell_m")}
    return msgspec.structs.replace(value, **place, **arrays)


def unfit(value: Shown) -> str:
    """Reason for which a shown value cannot be recorded; empty: it can."""
    if isinstance(value, Sightings):
        numbers = [
            number for each in value.found for number in (*each.place, *each.centre_px, each.angle, each.side_px, each.score)
        ]
        if not all(map(math.isfinite, numbers)):
            return "numbers that are not finite"
        return "" if value.width > 0 and value.height > 0 else f"a picture of {value.width} x {value.height} pixels"
    furthest = max(abs(value.left), abs(value.bottom))
    if not (furthest <= FURTHEST_M and 1e-6 <= value.cell_m <= FURTHEST_M):  # also refuses NaN
        return f"cells of {value.cell_m:g} m from ({value.left:g}, {value.bottom:g}) m"
    cells = value.pixels if isinstance(value, Mosaic) else value.probability
    if cells.size == 0:
        return "no cells"
    if isinstance(value, Mosaic):
        fits = cells.ndim == 3 and cells.shape[2] == 3 and cells.dtype == np.uint8
        return "" if fits else f"pixels {cells.shape} of {cells.dtype}; they must be (rows, columns, 3) of uint8"
    same = cells.ndim == 2 and cells.shape == value.seen.shape
    if same and cells.dtype == np.uint8 and value.seen.dtype == np.bool_:
        return ""
    return "cells that must be (rows, columns) of uint8 and of bool"


def check_body(body: Mapping[str, Any]) -> None:
    """Raise a `ValueError` or a `TypeError` if the recording could not hold this message body."""
    text = msgspec.json.encode(body)
    # The number of brackets bounds the depth; texts may contain brackets, too, so the count alone cannot refuse it.
    if text.count(b"{") + text.count(b"[") > DEEPEST and _depth(body) > DEEPEST:
        raise ValueError(f"a message may nest at most {DEEPEST} lists and mappings, not {_depth(body)}")


def _depth(value: object) -> int:
    """Deepest nesting of lists and mappings in a value."""
    depth, level = 0, [value]
    while level := [each for each in level if isinstance(each, dict | list)]:
        depth += 1
        inside: list[object] = []
        for each in level:
            inside += each.values() if isinstance(each, dict) else each
        level = inside
    return depth


def _item(value: object) -> object:
    """The value as a plain number if it is a NumPy number."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot be a {type(value).__name__}")


def _plain(value: object) -> object:
    """The value as plain numbers and lists if it is of NumPy (in a message body)."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"radio.send(): cannot send a {type(value).__name__}; use numbers, strings, bytes, lists and mappings")
