"""Events of vehicles and frames with known answers, and their recording."""

from collections.abc import Iterable, Sequence
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import Ticks
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.types import Follows, FrameReport, Note, States, Velocity, frozen

TENTH = Ticks.every(0.1)
Pose = tuple[float, float, float]


def states(time_ns: int, poses: dict[str, Pose]) -> Event:
    """True states from planar poses (x, y, yaw)."""
    zero = frozen(np.zeros((len(poses), 3)))
    position = frozen([(x, y, 0.0) for x, y, _ in poses.values()])
    attitude = frozen([quaternion_from_yaw(yaw) for _, _, yaw in poses.values()])
    value = States(names=tuple(poses), position=position, velocity=zero, attitude=attitude, angular_velocity=zero)
    return Event("world/states", time_ns, value)


def frame(number: int, sender: str, sent_ns: int, received: dict[str, int | None]) -> Event:
    """A frame and its arrival at each receiver (None: lost)."""
    count = len(received)
    value = FrameReport(
        frame=number,
        sender=sender,
        sent_ns=sent_ns,
        size_bytes=60,
        receivers=tuple(received),
        distance_m=frozen(np.full(count, 1.0 + number)),
        rssi_dbm=frozen(np.full(count, -60.0 - number)),
        received_ns=frozen([-1 if at is None else at for at in received.values()], np.int64),
        outcome=tuple("random loss" if at is None else "received" for at in received.values()),
        wall_materials=("wood",) * count,
    )
    parts = {name: frozen(np.full(count, 7.0)) for name in ("snr_db", "sinr_db", "path_loss_db", "wall_loss_db")}
    parts |= {name: frozen(np.full(count, 3.0)) for name in ("shadowing_db", "fading_db")}
    parts |= {name: frozen(np.full(count, 5), np.int64) for name in ("walls", "copy_ns")}
    return Event("radio/frame", sent_ns, msgspec.structs.replace(value, **parts))


def follows(vehicle: str, leader: str, slot: tuple[float, float], handle_m: float, time_ns: int = 0) -> Event:
    return Event(f"{vehicle}/follows", time_ns, Follows(leader=leader, slot=slot, handle_m=handle_m))


def note(vehicle: str, time_ns: int, **values: float | str | bool) -> Event:
    return Event(f"{vehicle}/note", time_ns, Note(values=values))


def recorder_after(
    names: Sequence[str], events: Iterable[Event], end_ns: int, ticks: Ticks = TENTH, world: Any = None
) -> Recorder:
    """A closed recorder of these events."""
    run = RunInfo(scenario="test", seed=3, duration_ns=end_ns, vehicles=tuple(names))
    agents = [AgentInfo(vehicle=name, agent="x", ticks=ticks, latency_ns=0, params={}, known=(), taken=()) for name in names]
    recorder = Recorder(run, record_ticks=TENTH, mcap=None, agents=agents, radius_m={}, world=world)
    for event in sorted(events, key=lambda event: event.time_ns):
        recorder.on(event)
    recorder.close(end_ns)
    return recorder


def metrics_after(
    names: Sequence[str], events: Iterable[Event], end_ns: int, window: tuple[float, float | None] = (0.0, None), **more: Any
) -> dict[str, Any]:
    """Metrics of these events; further arguments as of `recorder_after`."""
    return recorder_after(names, events, end_ns, **more).metrics(window=window)


def velocity(vehicle: str, time_ns: int, linear: tuple[float, float, float], yaw_rate: float = 0.0) -> Event:
    return Event(f"{vehicle}/command", time_ns, Velocity(linear=linear, yaw_rate=yaw_rate))
