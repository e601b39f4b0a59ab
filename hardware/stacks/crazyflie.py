"""Programs of cflib fly simulated Crazyflies over UDP, which cflib has for simulators.

One thread answers packets at once. At each tick of a vehicle its commander makes a velocity of the last set-point or manoeuvre,
and the log is sent. Set-points are followed as by the firmware: without one for 0.5 s the aircraft levels, after 2 s it is lost
(``supervisor.c``: COMMANDER_WDT_TIMEOUT_STABILIZE and ..._SHUTDOWN).
"""

import contextlib
import selectors
import socket
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, NamedTuple

import msgspec

from vcmvsp.cosim.agent import Observation
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.cosim.federate import Event, RunInfo, StackAnswer
from vcmvsp.cosim.frames import rotate2, wrap, yaw_of
from vcmvsp.cosim.hosts.remote_host import LinkError
from vcmvsp.cosim.types import Name, Vec3, VehicleState, Velocity
from vcmvsp.hardware.stacks.crtp import GREETING, NULL, Crazyflie, Flight, Manoeuvre, Order, Release, SetPoint, Stop
from vcmvsp.hardware.stacks.trajectories import Trajectory

STABILIZE_S, SHUTDOWN_S = 0.5, 2.0
GAIN = 2.0  # 1/s, speed for each m of error
FALL_M_PER_S = 1.0  # of a stopped aircraft: its autopilot cannot turn off the rotors
CHANNEL, SOURCE = 0xF3, 0xF1  # bits of port and channel in a header, and those of the request with which a connection begins
LOOK_S = 0.1

Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]


class _Plan(NamedTuple):
    """A manoeuvre under way, from rest to rest."""

    begin_s: float
    duration_s: float
    start: Vec3  # m
    goal: Vec3  # m
    yaw: float  # rad, at the end
    linear: bool
    lands: bool

    def at(self, now_s: float) -> SetPoint:
        """Set-point at a time.

        The polynomial of 7th degree without velocity, acceleration and jerk at both ends is 35 s^4 - 84 s^5 + 70 s^6 - 20 s^7.
        """
        s = 1.0 if self.duration_s <= 0.0 else min(max((now_s - self.begin_s) / self.duration_s, 0.0), 1.0)
        share, speed = s**4 * (35.0 - 84.0 * s + 70.0 * s * s - 20.0 * s**3), 140.0 * s**3 * (1.0 - s) ** 3
        if self.linear:
            share, speed = s, float(s < 1.0)
        way = [b - a for a, b in zip(self.start, self.goal, strict=True)]
        x, y, z = (a + share * each for a, each in zip(self.start, way, strict=True))
        if s == 1.0:
            return SetPoint(position=(x, y, z), yaw=self.yaw)
        vx, vy, vz = (speed * each / self.duration_s for each in way)
        return SetPoint((vx, vy, vz), (x, y, z), yaw=self.yaw)

    def over(self, now_s: float) -> bool:
        """Whether it has ended."""
        return now_s >= self.begin_s + self.duration_s


class _Flown(NamedTuple):
    """A trajectory under way."""

    begin_s: float
    trajectory: Trajectory
    lands: bool = False

    def at(self, now_s: float) -> SetPoint:
        """Set-point at a time."""
        pose = self.trajectory.at(now_s - self.begin_s)
        return SetPoint(pose.velocity, pose.position, pose.yaw, pose.yaw_rate)

    def over(self, now_s: float) -> bool:
        """Whether it has ended."""
        return now_s >= self.begin_s + self.trajectory.duration_s


class Commander:
    """Makes velocities of orders; times are simulated, s."""

    def __init__(self) -> None:
        self._set_point: SetPoint | None = None
        self._heard_s = 0.0  # time of the set-point
        self._plan: _Plan | _Flown | None = None
        self._flies = False
        self._last: SetPoint | None = None  # that was followed; None: it has not flown yet

    def take(self, order: Order, state: VehicleState, now_s: float) -> None:
        """Take an order."""
        match order:
            case SetPoint():
                self._set_point, self._heard_s, self._plan, self._flies = order, now_s, None, True
            case Manoeuvre():
                self._set_point, self._plan, self._flies = None, self._planned(order, state, now_s), True
            case Flight():
                self._set_point, self._plan, self._flies = None, self._flown(order, state, now_s), True
            case Release():
                if self._set_point is not None and self._flies:
                    self._plan = _Plan(now_s, 0.0, state.position, state.position, state.yaw, linear=False, lands=False)
                self._set_point = None
            case Stop():
                self._set_point = self._plan = None
                self._flies = False

    def command(self, state: VehicleState, now_s: float) -> Velocity:
        """Command of a tick.

        Raises:
            LinkError: there was no set-point for too long.
        """
        if self._plan is not None and self._plan.lands and self._plan.over(now_s):
            self.take(Stop(), state, now_s)
        if not self._flies:
            return Velocity() if self._last is None else Velocity(linear=(0.0, 0.0, -FALL_M_PER_S))
        if self._plan is not None:
            self._last = self._plan.at(now_s)
        elif self._set_point is not None:
            old_s = now_s - self._heard_s
            if old_s > SHUTDOWN_S:
                raise LinkError(f"no set-point for {SHUTDOWN_S:g} s")
            self._last = self._set_point if old_s <= STABILIZE_S else SetPoint()
        return _followed(self._last or SetPoint(), state)

    def _planned(self, order: Manoeuvre, state: VehicleState, now_s: float) -> _Plan:
        """The plan of a manoeuvre, from the present set-point if a manoeuvre is under way, else from the present place."""
        start, yaw = self._reference_pose(state, now_s)
        goal, turned = order.goal, yaw if order.yaw is None else order.yaw
        if order.kind != "go_to":
            goal = (start[0], start[1], goal[2])
        elif order.relative:
            goal, turned = (start[0] + goal[0], start[1] + goal[1], start[2] + goal[2]), yaw + turned
        return _Plan(now_s, order.duration_s, start, goal, turned, order.linear, order.kind == "land")

    def _flown(self, order: Flight, state: VehicleState, now_s: float) -> _Flown:
        trajectory = Trajectory(order.pieces, order.time_scale, order.reversed)
        if order.relative:
            place, yaw = self._reference_pose(state, now_s)
            trajectory = trajectory.moved_to(place, yaw if order.relative_yaw else None)
        return _Flown(now_s, trajectory)

    def _reference_pose(self, state: VehicleState, now_s: float) -> tuple[Vec3, float]:
        """Place and yaw of the present set-point if a manoeuvre is under way, else of the aircraft."""
        if self._plan is None:
            return state.position, state.yaw
        set_point = self._plan.at(now_s)
        x, y, z = set_point.position
        return (x or 0.0, y or 0.0, z or 0.0), set_point.yaw or 0.0


def _followed(set_point: SetPoint, state: VehicleState) -> Velocity:
    """Velocity towards a set-point."""
    speeds = [*set_point.velocity]
    if set_point.body:
        speeds[:2] = rotate2(speeds[0], speeds[1], state.yaw)
    for axis, place in enumerate(set_point.position):
        if place is not None:
            speeds[axis] += GAIN * (place - state.position[axis])
    rate = set_point.yaw_rate
    if set_point.yaw is not None:
        rate += GAIN * wrap(set_point.yaw - yaw_of(state.attitude))
    return Velocity(linear=(speeds[0], speeds[1], speeds[2]), yaw_rate=rate)


class _Aircraft:
    """One vehicle: its socket, its program, and what it is ordered to do."""

    def __init__(self, name: str, port: int) -> None:
        self.name, self.port = name, port
        self.commander, self.orders = Commander(), list[Order]()
        self.crtp = Crazyflie(self.orders.append)
        self.socket: socket.socket | None = None
        self.client: tuple[str, int] | None = None
        self.state: VehicleState | None = None
        self.now_s = 0.0


class CrazyflieStack:
    """Programs of cflib fly simulated quadrotors as Crazyflies, in real time.

    Args:
        vehicles: which vehicles, of a kind that flies; the programs replace their agents.
        first_port: UDP port of the first vehicle; those of the others follow. cflib finds 19850 to 19859.
        listen: address of the ports.
        flying: vehicles that fly. It comes from the program, like the next one.
        tell: receives lines for the user.
    """

    def __init__(
        self,
        *,
        vehicles: tuple[Name, ...],
        first_port: Port = 19850,
        listen: str = "127.0.0.1",
        flying: frozenset[str] = frozenset(),
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        if grounded := [name for name in vehicles if name not in flying]:
            raise ScenarioError(f"{grounded[0]} does not fly", key="vehicles")
        if first_port + len(vehicles) > 65536:
            raise ScenarioError(f"{first_port} leaves no ports for {len(vehicles)} vehicles", key="first_port")
        self.vehicles, self._listen, self._tell = vehicles, listen, tell
        self._aircraft = {name: _Aircraft(name, first_port + number) for number, name in enumerate(vehicles)}
        self._lock, self._over = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, run: RunInfo) -> None:
        """Open the ports, and answer from now on."""
        for each in self._aircraft.values():
            each.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            try:
                each.socket.bind((self._listen, each.port))
            except OSError as error:
                cause = f"port {each.port} of {self._listen} for {each.name} cannot be opened: {error.strerror or error}"
                raise FederateError("stack.crazyflie", f"{cause}; set first_port") from error
        at = ", ".join(f"udp://{self._listen}:{each.port} ({each.name})" for each in self._aircraft.values())
        self._tell(f"stack.crazyflie: programs of cflib reach {at}")
        self._thread = threading.Thread(target=self._serve, name="crazyflies", daemon=True)
        self._thread.start()

    def show(self, now_ns: int, readings: Sequence[Event]) -> None:
        """Readings of sensors are not passed on."""

    def ask(self, observations: Mapping[str, Observation]) -> None:
        """Send what is logged."""
        with self._lock:
            for name, observation in observations.items():
                each = self._aircraft[name]
                each.state, each.now_s = observation.state, 1e-9 * observation.time_ns
                for packet in each.crtp.logged(observation.time_ns // 1_000_000, observation.state):
                    _send(each, packet, each.client)

    def answer(self, vehicle: str) -> StackAnswer:
        """The command that follows the orders so far."""
        with self._lock:
            each = self._aircraft[vehicle]
            assert each.state is not None  # noqa: S101
            for order in each.orders:
                each.commander.take(order, each.state, each.now_s)
            each.orders.clear()
            return StackAnswer(each.commander.command(each.state, each.now_s))

    def close(self) -> None:
        """Close the ports, and tell what was refused."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()
        for each in self._aircraft.values():
            if each.socket is not None:
                each.socket.close()
                each.socket = None
                if causes := ", ".join(f"{count} {cause}" for cause, count in each.crtp.refused.items()):
                    self._tell(f"stack.crazyflie: {each.name}: refused packets: {causes}")

    def _serve(self) -> None:
        with selectors.DefaultSelector() as ready:
            for each in self._aircraft.values():
                if each.socket is not None:
                    ready.register(each.socket, selectors.EVENT_READ, each)
            while not self._over.is_set():
                for key, _ in ready.select(LOOK_S):
                    with contextlib.suppress(OSError):  # of a program that has gone
                        packet, client = key.data.socket.recvfrom(2048)
                        self._take(key.data, packet, client)

    def _take(self, each: _Aircraft, packet: bytes, client: tuple[str, int]) -> None:
        with self._lock:
            begins = len(packet) > 0 and packet[0] & CHANNEL == SOURCE
            if begins or each.client is None:
                each.client = client
            elif client != each.client and packet != NULL:
                each.crtp.refused["second program"] += 1
                return
            for answer in each.crtp.take(packet):
                _send(each, answer, client)
            if begins:
                _send(each, b"\0" + GREETING, client)


def _send(each: _Aircraft, packet: bytes, client: tuple[str, int] | None) -> None:
    if each.socket is not None and client is not None:
        with contextlib.suppress(OSError):
            each.socket.sendto(packet, client)
