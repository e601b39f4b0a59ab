"""A run with an observer, its recording, and the state of both at a time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import vcmvsp
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.types import (
    Array,
    Fix,
    Follows,
    FrameReport,
    Image,
    Later,
    Mosaic,
    Note,
    Presence,
    ProbabilityMap,
    RealStatus,
    Scan,
    Sightings,
    States,
)
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.view.messages import PageUpdate

SCENARIO: dict[str, Any] = {
    "name": "shown-again",
    "duration_s": 4.0,
    "physics": {"kind": "bullet"},
    "world": {
        "kind": "boxes",
        "boxes": [{"center": [4.0, 0.0, 0.5], "size": [0.2, 4.0, 1.0]}],
        "movables": [
            {"name": "crate", "mass_kg": 2.0, "solid": {"kind": "box", "center": [-3.0, 2.0, 0.2], "size": [0.4, 0.4, 0.4]}}
        ],
        "moving": [
            {
                "name": "cart",
                "solid": {"kind": "cylinder", "center": [0, 0, 0], "radius": 0.2, "height": 0.6},
                "times_s": [0.0, 3.0],
                "way": [[-4.0, -3.0, 0.3, 0.0], [4.0, -3.0, 0.3, 1.0]],
            }
        ],
        "targets": [{"name": "alpha", "way": [[0.0, 5.0], [4.0, 5.0]], "speed": 0.5}],
    },
    "radio": {"preset": "wifi-b-1", "loss": {"probability": 0.3}, "delay": {"seconds": 0.04}},
    "vehicles": {
        "kind": "p2dx",
        "sensors": {
            "scan": {"kind": "lms", "rate_hz": 5.0},
            "camera": {"kind": "nadir_camera", "rate_hz": 2.0, "width": 32, "height": 24},
            "place": {"kind": "positioning", "rate_hz": 3.0, "sigma_m": 0.1, "sigma_rad": 0.05},
        },
    },
    "record": {"sensors": ["*"]},
    "intervention": [
        {"kind": "halt", "at_s": 1.05, "vehicles": ["car2"]},
        {"kind": "outage", "at_s": 1.5, "for_s": 0.7},
        {"kind": "move", "at_s": 2.0, "obstacle": "crate", "position": [-3.0, -1.0], "yaw": 0.4},
        {"kind": "halt", "at_s": 2.55, "halted": False},
        {"kind": "halt", "at_s": 3.2},
    ],
    "vehicle": [
        {"name": "car1", "agent": {"kind": "trajectory", "path": "circle", "speed": 0.3, "yaw_rate": 0.15}},
        {"name": "car2", "pose": [-0.9, -0.5, 0.0], "agent": {"kind": "leader_follower", "leader": "car1"}},
        {"name": "car3", "pose": [-0.9, 0.5, 0.0], "agent": {"kind": "leader_follower", "leader": "car1"}},
    ],
}
END_NS = 4 * SECOND_NS
SENSORS = tuple(f"car{number}/{sensor}" for number in (1, 2, 3) for sensor in ("scan", "camera"))
NEWEST: Mapping[type, str] = {
    Scan: "scans",
    Image: "images",
    Follows: "places",
    Fix: "fixes",
    Presence: "presence",
    RealStatus: "real",
    ProbabilityMap: "maps",
    Mosaic: "mosaics",
    Sightings: "sightings",
}


class Run:
    """A run with the observer's states, and its folder."""

    def __init__(self, folder: Path, events: list[Event]) -> None:
        self.folder, self.events = folder, events


def observed_run(folder: Path) -> Run:
    """Run the scenario with an observer."""
    events: list[Event] = []

    def look(event: Event) -> None:
        value = event.value.get() if isinstance(event.value, Later) else event.value
        events.append(Event(event.key, event.time_ns, value))

    vcmvsp.run(SCENARIO, out=folder, observe=look)
    return Run(folder, events)


def observer_state(events: Sequence[Event], names: tuple[str, ...], time_ns: int) -> dict[str, Any]:
    """State of the observer at a time."""
    past = [event for event in events if event.time_ns <= time_ns]
    known: dict[str, Any] = {field: {} for field in (*NEWEST.values(), "notes", "heard_ns")}
    frames = [event.value for event in past if isinstance(event.value, FrameReport)]
    known["sent"], known["received"] = frame_counts(frames, names)
    known["states"] = None
    known["links"] = {each.sender: (each.sent_ns, each.receivers, each.rssi_dbm, each.outcome) for each in frames}
    for event in past:
        vehicle, value = event.key.partition("/")[0], event.value
        if isinstance(value, States) and event.time_ns % (SECOND_NS // 10) == 0:
            known["states"] = value
        elif isinstance(value, Note):
            known["notes"].setdefault(vehicle, {}).update(value.values)
        elif isinstance(value, FrameReport):
            received = zip(value.receivers, value.received_ns.tolist(), strict=True)
            known["heard_ns"] |= {receiver: event.time_ns for receiver, arrival_ns in received if arrival_ns >= 0}
        elif type(value) in NEWEST:
            known[NEWEST[type(value)]][event.key if isinstance(value, Scan | Image) else vehicle] = value
    return known


def frame_counts(frames: Sequence[FrameReport], names: tuple[str, ...]) -> tuple[Array, Array]:
    """Sent and received frames, a row per sender."""
    sent, received = (np.zeros((len(names),) * 2, np.int64) for _ in range(2))
    for each in frames:
        for receiver, outcome in zip(each.receivers, each.outcome, strict=True):
            pair = names.index(each.sender), names.index(receiver)
            sent[pair] += 1
            received[pair] += outcome == "received"
    return sent, received


def recording_state(shown: PageUpdate) -> dict[str, Any]:
    """State of the recording at a time."""
    links = {each.sender: (each.sent_ns, each.receivers, each.rssi_dbm, each.outcome) for each in shown.links}
    for each in shown.links:
        assert each.received.tolist() == [outcome == "received" for outcome in each.outcome]
    fields = (*NEWEST.values(), "notes", "heard_ns", "sent", "received")
    return {**{field: getattr(shown, field) for field in fields}, "states": shown.states, "links": links}


def assert_same(one: Any, other: Any, where: str = "") -> None:
    """Equal to the last bit; only the angle between beams is rounded, of a scan that states its ends."""
    if isinstance(one, Mapping):
        assert set(one) == set(other), where
        for name, value in one.items():
            assert_same(value, other[name], f"{where}/{name}")
    elif isinstance(one, Scan):
        assert one.angle_step == pytest.approx(other.angle_step, rel=1e-12)
        assert encode(msgspec.structs.replace(one, angle_step=0.0)) == encode(msgspec.structs.replace(other, angle_step=0.0))
    elif isinstance(one, Fix):  # a heading is stored as a quaternion
        assert one.yaw == (None if other.yaw is None else pytest.approx(other.yaw, abs=1e-12))
        same = {"yaw": 0.0, "sigma_z_m": None}
        assert msgspec.structs.replace(one, **same) == msgspec.structs.replace(other, **same)
    else:
        assert encode(one) == encode(other), where


def all_of(shown: PageUpdate) -> dict[str, Any]:
    """Everything on display, except the pace."""
    return recording_state(shown) | {name: getattr(shown, name) for name in ("obstacles", "targets", "lines", "halted")}


def chunk_ends(data: bytes) -> list[int]:
    """Offsets at which the chunks of a file end."""
    ends, place = [], 8
    while data[place] != 0x0F:
        opcode, length = data[place], int.from_bytes(data[place + 1 : place + 9], "little")
        place += 9 + length
        if opcode == 0x06:
            ends.append(place)
    return ends
