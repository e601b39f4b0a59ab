"""Driver of a Crazyflie by Bitcraze's library cflib, over its radio, USB or UDP.

cflib is under the GPL 3.0, is not installed with this project, and is imported only when a Crazyflie is opened. Its threads
call back; one thread here takes what they put into a queue, and sends set-points, as other drivers do.
"""

import contextlib
import math
import queue
import time
from typing import Annotated, Any

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.frames import Quaternion, product, quaternion_from_yaw
from vcmvsp.cosim.types import ORIGIN, Odometry, Positive, Vec3, VehicleState, Velocity
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, HandshakeError, LinkLost, PortError, Sample, finite
from vcmvsp.hardware.drivers.threaded import CommandRepeater, QueueDriver

PLACE, SMALL = ("x", "y", "z"), ("vx", "vy", "vz", "roll", "pitch", "yaw")  # of stateEstimate; as floats, and of 16 bits
BATTERY = "pm.vbat"
AGAIN_NS = SECOND_NS // 20  # between set-points: the firmware levels after 0.5 s without one
CLIMB_M_PER_S = 0.4  # of take-off and landing
SETTLE_S = 1.0  # after either
LANDED_M = 0.03

Period = Annotated[int, msgspec.Meta(ge=10, le=500, multiple_of=10)]  # ms
ConnectTime = Annotated[float, msgspec.Meta(gt=0, le=15)]  # s


class CrazyflieDriver(QueueDriver):
    """A Crazyflie (`hardware.drivers.base.Driver`), which takes a velocity in the world and a yaw rate.

    Args:
        uri: of cflib, such as ``radio://0/80/2M/E7E7E7E7E7``, ``usb://0`` or ``udp://127.0.0.1:19850``.
        takeoff_m: height of a take-off on opening, m; it lands where it is closed. Default: it flies already.
        origin: of its own frame in the world, m.
        telemetry_ms: time between two reports of its state.
        connect_s: for the connection, with its tables.
        silence_s: without a report it counts as lost.
        command_timeout_s: without a command it is stopped.
    """

    _who = "Crazyflie"
    _speeds = staticmethod(finite)

    def __init__(
        self,
        *,
        uri: str,
        takeoff_m: Positive | None = None,
        origin: Vec3 = ORIGIN,
        telemetry_ms: Period = 20,
        connect_s: ConnectTime = 10.0,
        silence_s: Positive = 1.0,
        command_timeout_s: CommandTimeout = COMMAND_TIMEOUT_S,
    ) -> None:
        self._flight_s = 0.0 if takeoff_m is None else takeoff_m / CLIMB_M_PER_S + SETTLE_S
        super().__init__(uri, open_deadline_s=connect_s + self._flight_s + 5.0, close_deadline_s=self._flight_s + 5.0)
        self._takeoff_m, self._origin, self._telemetry_ms = takeoff_m, origin, telemetry_ms
        self._connect_s, self._silence_s, self._timeout_s = connect_s, silence_s, command_timeout_s

    def _prepare(self, start: Vec3) -> None:
        self._repeater = CommandRepeater(Velocity(), self._timeout_s, again_ns=AGAIN_NS)
        self._news: queue.SimpleQueue[dict[str, float] | str | None] = queue.SimpleQueue()  # a report, or why it is lost
        self._connected, self._number = False, 0

    def _work(self) -> None:
        aircraft = self._opened()
        try:
            if self._takeoff_m is not None:
                aircraft.high_level_commander.takeoff(self._takeoff_m, self._takeoff_m / CLIMB_M_PER_S)
                self._receive_for(self._flight_s)
            self._connected = True
            self._notice("connected", f"a Crazyflie at {self.device}")
            self._converse(aircraft)
        finally:
            self._connected = False
            self._leave(aircraft)

    def _opened(self) -> Any:
        """A connected aircraft that reports its state."""
        try:
            from cflib import crtp
            from cflib.crazyflie import Crazyflie
            from cflib.crazyflie.log import LogConfig
        except ModuleNotFoundError as error:
            raise PortError(self.device, f"it needs {error.name}", "pip install 'vcmvsp[crazyflie]'") from error
        crtp.init_drivers()
        aircraft, answers = Crazyflie(rw_cache=None), queue.SimpleQueue[str]()
        aircraft.connected.add_callback(lambda _uri: answers.put(""))
        aircraft.connection_failed.add_callback(lambda _uri, why: answers.put(why.splitlines()[0]))
        aircraft.connection_lost.add_callback(lambda _uri, why: self._news.put(why.splitlines()[0]))
        aircraft.open_link(self.device)
        try:
            why = answers.get(timeout=self._connect_s)
        except queue.Empty:
            why = f"no answer within {self._connect_s:g} s"
        if not why:
            report = LogConfig("vcmvsp", self._telemetry_ms)
            for name in PLACE:
                report.add_variable(f"stateEstimate.{name}", "float")
            for name in (*(f"stateEstimate.{each}" for each in SMALL), BATTERY):
                report.add_variable(name, "FP16")
            report.data_received_cb.add_callback(lambda _time_ms, values, _block: self._news.put(values))
            with contextlib.suppress(KeyError):  # a variable that it does not have
                aircraft.log.add_config(report)
                report.start()
                return aircraft
            why = "it does not report its position"
        aircraft.close_link()
        raise HandshakeError(self.device, why, "check its battery, its address and the radio")

    def _converse(self, aircraft: Any) -> None:
        heard_ns = time.monotonic_ns()
        while not self._closing.is_set():
            command, due_ns = self._due_command()
            while command is not None:
                turn_deg = math.degrees(command.yaw_rate)
                aircraft.commander.send_velocity_world_setpoint(*command.linear, turn_deg)
                command, due_ns = self._due_command()
            lost_ns = heard_ns + seconds_to_ns(self._silence_s)
            if self._receive(min(due_ns, lost_ns)):
                heard_ns = time.monotonic_ns()
                self._ready.set()
            elif time.monotonic_ns() >= lost_ns:
                raise LinkLost(self.device, f"no report for {self._silence_s:g} s", "check its battery and the radio")

    def _receive_for(self, seconds: float) -> None:
        until_ns = time.monotonic_ns() + seconds_to_ns(seconds)
        while time.monotonic_ns() < until_ns:
            self._receive(until_ns)

    def _receive(self, until_ns: int) -> bool:
        """Take the next news before this time; whether it is a report."""
        news = self._next_news(until_ns)
        if isinstance(news, str):
            raise LinkLost(self.device, news, "check its battery and the radio")
        if news is None:
            return False
        self._number += 1
        sample = _sample(news, self._number, self._origin, self._repeater.stopped)
        with self._lock:
            self._sample = sample
        return True

    def _leave(self, aircraft: Any) -> None:
        """Land, if it took off by itself, else stay in place; and close the connection."""
        aircraft.commander.send_notify_setpoint_stop()
        if self._takeoff_m is not None:
            aircraft.high_level_commander.land(LANDED_M, self._takeoff_m / CLIMB_M_PER_S)
            with contextlib.suppress(LinkLost):
                self._receive_for(self._flight_s)
            aircraft.high_level_commander.stop()
        aircraft.close_link()


def _sample(report: dict[str, float], number: int, origin: Vec3, stopped: str) -> Sample:
    """Sample of a report; the firmware counts the pitch upwards."""
    x, y, z, vx, vy, vz, *degrees = (report[f"stateEstimate.{name}"] for name in (*PLACE, *SMALL))
    roll, pitch, yaw = map(math.radians, degrees)
    about_y = math.cos(-0.5 * pitch), 0.0, math.sin(-0.5 * pitch), 0.0
    about_x = math.cos(0.5 * roll), math.sin(0.5 * roll), 0.0, 0.0
    attitude: Quaternion = product(product(quaternion_from_yaw(yaw), about_y), about_x)
    place, velocity = (origin[0] + x, origin[1] + y, origin[2] + z), (vx, vy, vz)
    forward = vx * math.cos(yaw) + vy * math.sin(yaw)
    now_ns = time.monotonic_ns()
    return Sample(
        number=number,
        link=1,
        arrived_ns=now_ns,
        measured_ns=now_ns,
        odometry=Odometry(pose=(place[0], place[1], yaw), v=forward, w=0.0),
        state=VehicleState(position=place, velocity=velocity, attitude=attitude),
        battery_v=report[BATTERY],
        stopped=stopped,
    )
