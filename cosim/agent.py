"""The author's side: an `Agent` sees an `Observation`, may use its `Radio`, and returns a command.

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
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import (
    Follows,
    Message,
    Mosaic,
    OnLost,
    ProbabilityMap,
    Reading,
    Reception,
    Sightings,
    Value,
    VehicleState,
    Velocity,
    Waypoint,
)

Shown = ProbabilityMap | Sightings | Mosaic
SHOWN: Mapping[type[Shown], str] = {ProbabilityMap: "map", Sightings: "sightings", Mosaic: "mosaic"}
CELLS = ("probability", "seen", "pixels")  # of what is shown
FURTHEST_M = 1e9  # from the origin, likewise

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


class Body(Value, frozen=True, kw_only=True):
    """How much room a vehicle takes, and how it moves."""

    width_m: float  # across, where it drives straight ahead
    radius_m: float  # of the circle around its reference point that holds all of it
    flies: bool = False  # its commands are in the world frame, and it can move sideways


class VehicleInfo(Value, frozen=True, kw_only=True):
    """What an agent is told once, before its first tick."""

    name: str
    vehicles: tuple[str, ...]
    period_s: float
    latency_s: float
    seed: int
    body: Body | None = None  # None: nobody said
    sensors: tuple[str, ...] | None = None  # what the vehicle carries, by name; None: nobody said
    beside_m: Mapping[str, float] = msgspec.field(default_factory=dict)  # m from the reference point, of those beside it

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
    replaced: dict[str, tuple[str, ...]] = msgspec.field(default_factory=dict)  # tables of another kind now: what was set
    period_s: float | None  # None: the class's own period
    latency_s: float
    source: str  # the scenario file, for error messages
    sensors: tuple[str, ...] = ()  # what the vehicle carries, by name
    beside_m: Mapping[str, float] = msgspec.field(default_factory=dict)  # m from the reference point, of those beside it
    body: Body | None = None
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
    files: tuple[str, ...] = ()  # those that its parameters name, as they are written


@functools.lru_cache(maxsize=1)
def _name_set(names: tuple[str, ...]) -> frozenset[str]:
    """One set of names for all agents of a run: each with its own would take memory that grows with their square."""
    return frozenset(names)


class Radio:
    """The agent's own transmitter: what is sent here enters the emulated channel when the tick ends."""

    def __init__(self, vehicle: str, vehicles: tuple[str, ...]) -> None:
        self._vehicle, self._vehicles = vehicle, _name_set(vehicles)
        self._outbox: list[Message] = []

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
        """Send a message to all who can hear it, or to one vehicle; the answer is its payload size in bytes.

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
        return size

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
    _shown: dict[str, Shown] | None = None

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
            if type(value) is float or value is True or value is False:  # as nearly all are
                self._notes[name] = value
            else:
                self._notes[name] = value.encode().decode() if isinstance(value, str) else float(value)

    def show(self, value: Shown) -> None:
        """Have a map, sightings or a mosaic of this tick recorded, under ``<vehicle>/map``, ``/sightings``, ``/mosaic``.

        It is copied as it would be on its way from a host: arrays may change afterwards.

        Raises:
            TypeError: it is none of these.
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
        """Take what was shown since the last call, by key (for the host of the agent)."""
        shown, self._shown = self._shown, None
        return shown or {}

    def drain_notes(self) -> dict[str, float | str | bool]:
        """Take what was noted since the last call (for the host of the agent)."""
        notes, self._notes = self._notes, None
        return notes or {}


def _copied(value: Shown) -> Shown:
    """The same in plain numbers and arrays of its own, as it would come over a wire."""
    if isinstance(value, Sightings):
        return msgspec.msgpack.decode(msgspec.msgpack.encode(value, enc_hook=_item), type=Sightings)
    arrays = {name: np.array(getattr(value, name), order="C") for name in CELLS if hasattr(value, name)}
    for each in arrays.values():
        each.flags.writeable = False
    place = {name: float(getattr(value, name)) for name in ("left", "bottom", "cell_m")}
    return msgspec.structs.replace(value, **place, **arrays)


def unfit(value: Shown) -> str:
    """Why something shown cannot be recorded; empty: it can."""
    if isinstance(value, Sightings):
        numbers = [
            number for each in value.found for number in (*each.place, *each.centre_px, each.angle, each.side_px, each.score)
        ]
        if not all(map(math.isfinite, numbers)):
            return "numbers that are not finite"
        return "" if value.width > 0 and value.height > 0 else f"a picture of {value.width} x {value.height} pixels"
    furthest = max(abs(value.left), abs(value.bottom))
    if not (furthest <= FURTHEST_M and 1e-6 <= value.cell_m <= FURTHEST_M):  # NaN is not either
        return f"cells of {value.cell_m:g} m from ({value.left:g}, {value.bottom:g}) m"
    cells = value.pixels if isinstance(value, Mosaic) else value.probability
    if cells.size == 0:
        return "no cells"
    if isinstance(value, Mosaic):
        fits = cells.ndim == 3 and cells.shape[2] == 3 and cells.dtype == np.uint8
        return "" if fits else f"pixels {cells.shape} of {cells.dtype}, which are to be (rows, columns, 3) of uint8"
    same = cells.ndim == 2 and cells.shape == value.seen.shape
    if same and cells.dtype == np.uint8 and value.seen.dtype == np.bool_:
        return ""
    return "cells that are not (rows, columns) of uint8 and of bool"


def check_body(body: Mapping[str, Any]) -> None:
    """Raise a `ValueError` or a `TypeError` if the recording could not hold this body of a message."""
    text = msgspec.json.encode(body)
    # No deeper than it has brackets; texts may have some, too, so that the count alone is not enough to refuse it.
    if text.count(b"{") + text.count(b"[") > DEEPEST and _depth(body) > DEEPEST:
        raise ValueError(f"a message may have {DEEPEST} lists and mappings inside one another, not {_depth(body)}")


def _depth(value: object) -> int:
    """How many lists and mappings are inside one another, at most."""
    depth, level = 0, [value]
    while level := [each for each in level if isinstance(each, dict | list)]:
        depth += 1
        level = [inner for each in level for inner in (each.values() if isinstance(each, dict) else each)]
    return depth


def _item(value: object) -> object:
    """NumPy numbers become plain ones."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"cannot be a {type(value).__name__}")


def _plain(value: object) -> object:
    """NumPy numbers and arrays in a message body become plain ones."""
    if isinstance(value, np.generic | np.ndarray):
        return value.tolist()
    raise TypeError(f"radio.send(): cannot send a {type(value).__name__}; use numbers, strings, bytes, lists and mappings")
