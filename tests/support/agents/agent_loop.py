"""Vehicles and a radio without the platform: a minimal loop around a ground vehicle's algorithm."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.frames import arc, quaternion_from_yaw
from vcmvsp.cosim.received import ReceivedMessages
from vcmvsp.cosim.types import Follows, Message, Reception, Vec3, VehicleState, Velocity

T = 0.1
Floats = NDArray[np.float64]
Pose = tuple[float, float, float]
Lost = Callable[[int, int], bool]  # (tick, follower) -> whether the report of that tick is lost on the way to that follower
Value = TypeVar("Value")


@dataclass
class Vehicle:
    """A unicycle; its speeds follow the command at once (``tau`` 0) or as a first-order servo."""

    pose: Pose
    v: float = 0.0
    w: float = 0.0
    tau_v: float = 0.0
    tau_w: float = 0.0

    def move(self, command: Velocity, dt: float) -> None:
        v, w = command.linear[0], command.yaw_rate
        if self.tau_v == 0.0:
            self.v, self.w = v, w
            self.pose = arc(self.pose, v, w, dt)
            return
        steps = 20
        h = dt / steps
        decay_v, decay_w = math.exp(-h / self.tau_v), math.exp(-h / self.tau_w)
        for _ in range(steps):  # speeds exactly; the pose by the arc of the mean speeds of each step
            mean_v = v + (self.v - v) * self.tau_v / h * (1.0 - decay_v)
            mean_w = w + (self.w - w) * self.tau_w / h * (1.0 - decay_w)
            self.pose = arc(self.pose, mean_v, mean_w, h)
            self.v, self.w = v + (self.v - v) * decay_v, w + (self.w - w) * decay_w


@dataclass
class Uav:
    """A point that moves exactly as commanded."""

    position: Vec3
    yaw: float = 0.0
    velocity: Vec3 = (0.0, 0.0, 0.0)
    yaw_rate: float = 0.0

    def see(self, time_ns: int, received: Sequence[Reception] = (), **readings: Any) -> Observation:
        """Observation of a vehicle with exact sensors; None: no such reading."""
        state = VehicleState(
            position=self.position,
            velocity=self.velocity,
            attitude=quaternion_from_yaw(self.yaw),
            angular_velocity=(0.0, 0.0, self.yaw_rate),
        )
        there = {name: reading for name, reading in readings.items() if reading is not None}
        messages = ReceivedMessages.of(received, time_ns)
        return Observation(vehicle="me", time_ns=time_ns, state=state, readings=there, heard=messages)

    def move(self, command: Velocity) -> None:
        self.velocity, self.yaw_rate = command.linear, command.yaw_rate
        x, y, z = (p + T * v for p, v in zip(self.position, self.velocity, strict=True))
        self.position, self.yaw = (x, y, z), self.yaw + T * self.yaw_rate


def observe(
    pose: Pose, time_ns: int, received: Sequence[Reception] = (), *, v: float = 0.0, w: float = 0.0, **readings: Any
) -> Observation:
    """Observation of a wheeled vehicle."""
    x, y, yaw = pose
    return Uav((x, y, 0.0), yaw, (v * math.cos(yaw), v * math.sin(yaw), 0.0), w).see(time_ns, received, **readings)


def reception_of(message: Message) -> Reception:
    """Reception of this content; algorithms here use nothing else of it."""
    return Reception(message=message, rssi_dbm=-50.0, sent_ns=0, received_ns=1)


def reception_of_body(sender: str, body: Any) -> Reception:
    """Reception of an encoded message."""
    return reception_of(Message(sender=sender, body=body, size_bytes=9))


def bodies(radio: Radio) -> list[dict[str, Any]]:
    """Bodies of the messages sent since the last call."""
    return [message.body for message in radio.drain()]  # type: ignore[misc]


def present(value: Value | None) -> Value:
    """The value, which must be there."""
    assert value is not None
    return value


def info(name: str = "a", vehicles: Sequence[str] = ("a", "b"), **more: Any) -> VehicleInfo:
    """Agent information at the start."""
    return VehicleInfo(**{"name": name, "vehicles": tuple(vehicles), "period_s": T, "latency_s": 0.0, "seed": 1, **more})


def formation_error(leader: Floats, follower: Floats, follows: Follows) -> Floats:
    """z (..., 2), m: offset of the follower's handle from its point, in the follower's frame; poses (..., 3) are true ones."""
    (slot_x, slot_y), ell = follows.slot, follows.handle_m
    lead, own = np.exp(1j * leader[..., 2]), np.exp(1j * follower[..., 2])
    point = leader[..., 0] + 1j * leader[..., 1] + lead * (slot_x + ell + 1j * slot_y)
    handle = follower[..., 0] + 1j * follower[..., 1] + own * ell
    z = (point - handle) / own
    return np.stack([z.real, z.imag], axis=-1)


@dataclass
class Drive:
    """Record of every tick before its command."""

    leader: Floats  # (ticks, 3)
    followers: Floats  # (ticks, n, 3)
    commands: Floats  # (ticks, n, 2), v and w
    z: Floats  # (ticks, n, 2)
    reports: list[int]  # reports that the leader sent, by tick

    @property
    def error(self) -> Floats:
        """|z| (ticks, n) in m."""
        return np.hypot(self.z[..., 0], self.z[..., 1])


def drive(
    leader: Agent,
    followers: Sequence[LeaderFollower],
    *,
    poses: Sequence[Pose] | None = None,
    duration_s: float,
    period_s: float = 0.1,
    delay_ticks: int = 0,
    lost: Lost = lambda tick, follower: False,
    lost_back: Lost = lambda tick, follower: False,
    tau: tuple[float, float] = (0.0, 0.0),
    rolling: float = 0.0,
) -> Drive:
    """Close the loop: the leader starts at the origin, each follower in its slot behind it unless ``poses`` say otherwise.

    The leader is called ``leader``, the followers ``f0``, ``f1``, ...; a leader among the followers comes before its own
    followers. Reports arrive ``delay_ticks`` after transmission; with 0, in the same tick. Messages of followers to the leader
    arrive a tick later than that, unless ``lost_back``. ``rolling`` is the followers' first speed.
    """
    starts = [(*each.follows.slot, 0.0) for each in followers if each.follows] if poses is None else poses
    names = [f"f{i}" for i in range(len(followers))]
    everybody = ("leader", *names)
    for name, agent in zip(everybody, (leader, *followers), strict=True):
        agent.start(info(name, everybody, period_s=period_s))
    front = Vehicle((0.0, 0.0, 0.0))
    cars = [Vehicle(pose, rolling, 0.0, *tau) for pose in starts]
    lead_radio, radios = Radio("leader", everybody), [Radio(name, everybody) for name in names]
    on_air: list[list[Reception]] = []  # by the tick of sending
    back: list[list[Reception]] = []  # to the leader alone
    reports: list[int] = []
    log: list[tuple[Pose, list[Pose], list[tuple[float, float]]]] = []
    for tick in range(round(duration_s / period_s) + 1):
        now_ns = round(tick * period_s * 1e9)
        answers = back[tick - 1 - delay_ticks] if tick > delay_ticks else ()
        lead_command = leader.act(observe(front.pose, now_ns, answers), lead_radio)
        assert isinstance(lead_command, Velocity)
        on_air.append([reception_of(message) for message in lead_radio.drain()])
        back.append([])
        reports.append(len(on_air[tick]))
        sent = tick - delay_ticks
        orders = []
        for i, (agent, car, radio) in enumerate(zip(followers, cars, radios, strict=True)):
            received = () if sent < 0 or lost(sent, i) else on_air[sent]
            orders.append(agent.act(observe(car.pose, now_ns, received, v=car.v, w=car.w), radio))
            for message in radio.drain():
                if message.to is None:
                    on_air[tick].append(reception_of(message))
                elif message.to == "leader" and not lost_back(tick, i):
                    back[tick].append(reception_of(message))
        log.append((front.pose, [car.pose for car in cars], [(each.linear[0], each.yaw_rate) for each in orders]))
        front.move(lead_command, period_s)
        for car, order in zip(cars, orders, strict=True):
            car.move(order, period_s)
    lead, own, commands = (np.array(column) for column in zip(*log, strict=True))
    paths = {"leader": lead, **{name: own[:, i] for i, name in enumerate(names)}}
    z = [
        formation_error(paths[str(each.leader)], paths[name], each.follows)
        for name, each in zip(names, followers, strict=True)
        if each.follows
    ]
    return Drive(lead, own, commands, np.stack(z, axis=1), reports)
