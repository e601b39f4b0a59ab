"""A robot in software behind the protocol of a driver: delay, jitter, lost packets and wheel slip, all from a seed.

It has no thread and no port: each call computes what happened since the last one. The result depends only on the commands and
the times of the calls, so that it repeats with a given clock.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable
from math import inf, sqrt

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.frames import arc
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.types import ORIGIN, NonNegative, Odometry, Positive, Probability, Rate, Seed, Vec3, Velocity
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, LinkLost, Notice, Sample, What, checked
from vcmvsp.hardware.drivers.threaded import NOT_YET

TICK_NS = 10_000_000  # of the motion
TRACK_M = 0.3  # between the wheels, for the speeds of wheels alone


class Bench:
    """A differential-drive robot that follows speeds within its accelerations (`hardware.drivers.base.Driver`).

    Args:
        rate_hz: samples a second.
        latency_s: from measurement to arrival.
        jitter_s: maximum additional delay, uniform; samples keep their order.
        drop_out: probability that a sample is lost.
        scale: odometry distance per metre, m.
        turn_per_m: false turn of odometry per metre, rad: wheels of unequal size.
        slip: standard deviation of odometry's heading after a metre, rad; it grows with the square root of the distance.
        max_speed: m/s.
        max_yaw_rate: rad/s.
        accel: m/s2, of a growing speed.
        decel: m/s2, of a falling speed.
        yaw_accel: rad/s2.
        unplugged_s: time until the link is lost; None: never.
        command_timeout_s: without a command, the robot is stopped.
        seed: of jitter, drop-outs and slip.
        name: for messages; robots of different names draw different numbers.
        now: the clock, ns.
    """

    ground_only = True
    open_deadline_s = close_deadline_s = 1.0  # neither waits

    def __init__(
        self,
        *,
        rate_hz: Rate = 10.0,
        latency_s: NonNegative = 0.05,
        jitter_s: NonNegative = 0.0,
        drop_out: Probability = 0.0,
        scale: Positive = 1.0,
        turn_per_m: float = 0.0,
        slip: NonNegative = 0.0,
        max_speed: Positive = 0.75,
        max_yaw_rate: Positive = 1.75,
        accel: Positive = 0.3,
        decel: Positive = 0.75,
        yaw_accel: Positive = 1.75,
        unplugged_s: NonNegative | None = None,
        command_timeout_s: CommandTimeout = COMMAND_TIMEOUT_S,
        seed: Seed = 0,
        name: str = "bench",
        now: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self.device = name
        self._period_ns = round(SECOND_NS / rate_hz)
        self._latency_s, self._jitter_s, self._drop_out = latency_s, jitter_s, drop_out
        self._scale, self._turn_per_m, self._slip = scale, turn_per_m, slip
        self._most = (max_speed, max_yaw_rate)
        self._accel, self._decel, self._yaw_accel = accel, decel, yaw_accel
        self._unplugged_ns = None if unplugged_s is None else seconds_to_ns(unplugged_s)
        self._timeout_s, self._timeout_ns = command_timeout_s, seconds_to_ns(command_timeout_s)
        self._seed, self._now = seed, now
        self._notices: list[Notice] = []
        self._is_open = False

    def open(self, start: Vec3 = ORIGIN) -> None:
        """Stand at ``start``."""
        self.pose = start  # true pose: x m, y m, yaw rad
        self._odometry = start  # odometry pose
        self._v = self._w = 0.0
        self._command = (0.0, 0.0)
        self._stopped, self._given_ns = NOT_YET, 0
        self._origin_ns, self._time_ns = self._now(), 0  # start, and time since then
        self._under_way: deque[Sample] = deque()
        self._samples, self._arrival_ns = 0, 0
        self._link_draws = stream(self._seed, f"{self.device}/link")  # separate streams: slip does not change drop-outs
        self._slip_draws = stream(self._seed, f"{self.device}/slip")
        self._is_open, self._lost = True, False
        self._notice("connected", "a robot in software")

    def read(self) -> Sample | None:
        """The newest sample that has arrived and was not read yet."""
        now_ns = self._origin_ns + self._advance()
        newest = None
        while self._under_way and self._under_way[0].arrived_ns <= now_ns:
            newest = self._under_way.popleft()
        return newest

    def write(self, velocity: Velocity) -> None:
        """Command a speed."""
        v, w = checked(velocity)
        self._given_ns = self._advance()
        self._command = _towards(0.0, v, self._most[0]), _towards(0.0, w, self._most[1])
        self._stopped = ""

    def stop(self, cause: str) -> None:
        """Zero speed; never raises."""
        with contextlib.suppress(LinkLost, RuntimeError):
            self._advance()
        self._halt(cause)

    def notices(self) -> list[Notice]:
        """What happened since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def close(self) -> None:
        """Nothing to release."""
        self._is_open = False

    def _advance(self) -> int:
        """Compute what happened until now; the time since `open`, ns."""
        if not self._is_open:
            raise RuntimeError(f"{self.device} is not open")
        now_ns = self._now() - self._origin_ns
        while True:
            sample_ns = (self._samples + 1) * self._period_ns
            timeout_ns = self._given_ns + self._timeout_ns if not self._stopped else inf
            next_ns = int(min((self._time_ns // TICK_NS + 1) * TICK_NS, sample_ns, timeout_ns))
            if next_ns > now_ns or (self._unplugged_ns is not None and next_ns > self._unplugged_ns):
                break
            self._move((next_ns - self._time_ns) / SECOND_NS)
            self._time_ns = next_ns
            if next_ns == timeout_ns:
                self._halt(f"no command for {self._timeout_s:g} s")
            if next_ns == sample_ns:
                self._send()
        if self._unplugged_ns is not None and now_ns >= self._unplugged_ns:
            if not self._lost:
                self._lost = True
                self._notice("lost", "unplugged_s has passed")
            raise LinkLost(self.device, "the link is lost", "unplugged_s asks for this")
        return now_ns

    def _move(self, dt: float) -> None:
        v, w = self._command
        braking = abs(v) < abs(self._v) or v * self._v < 0.0
        self._v = _towards(self._v, v, dt * (self._decel if braking else self._accel))
        self._w = _towards(self._w, w, dt * self._yaw_accel)
        self.pose = arc(self.pose, self._v, self._w, dt)
        way = abs(self._v) * dt
        turned = self._turn_per_m * way
        if self._slip and way:
            turned += self._slip * sqrt(way) * self._slip_draws.standard_normal()
        x, y, yaw = arc(self._odometry, self._scale * self._v, self._w, dt)
        self._odometry = (x, y, yaw + turned)

    def _send(self) -> None:
        self._samples += 1
        lost, late = self._link_draws.random(2).tolist()
        if lost < self._drop_out:
            return
        measured_ns = self._origin_ns + self._time_ns
        arrived_ns = measured_ns + seconds_to_ns(self._latency_s + late * self._jitter_s)
        self._arrival_ns = max(self._arrival_ns, arrived_ns)  # samples keep their order
        sample = Sample(
            number=self._samples,
            link=1,
            arrived_ns=self._arrival_ns,
            measured_ns=measured_ns,
            odometry=Odometry(pose=self._odometry, v=self._scale * self._v, w=self._w),
            wheels=(self._v - 0.5 * TRACK_M * self._w, self._v + 0.5 * TRACK_M * self._w),
            stopped=self._stopped,
        )
        self._under_way.append(sample)

    def _halt(self, cause: str) -> None:
        self._command, self._stopped = (0.0, 0.0), cause
        self._notice("stopped", cause)

    def _notice(self, what: What, cause: str) -> None:
        self._notices.append(Notice(time_ns=self._now(), what=what, cause=cause))


def _towards(value: float, goal: float, most: float) -> float:
    return value + min(max(goal - value, -most), most)
