"""Samples of ARCOS information packets: pose from counters that wrap, speeds, sonars, flags, time of measurement."""

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Odometry, Vec3
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot
from vcmvsp.hardware.drivers.arcos.sip import COUNT_BITS, Sip
from vcmvsp.hardware.drivers.base import Sample

HEADING_COUNTS = 4096  # a turn
EMERGENCY_STOP = 1 << 5  # bit of the flags in ARCOS
AGE_NS = 50_000_000  # half a packet period: packets have no time, and their data is up to one period old
DRIFT = 0.01  # relative error of the robot's period
LEAP_S = 1.0  # longest step of the pose: greatest speed times (time since the last packet + this)


class ArcosSampler:
    """Converts packets of a robot to samples, from its start pose, over reconnections.

    Attributes:
        leaps: impossible steps of the pose, which are ignored: another program set the odometry.
    """

    def __init__(self, start: Vec3) -> None:
        self.leaps = 0
        self._pose = start
        self._number = self._link = 0
        self._last: Sip | None = None
        self._turned = 0.0  # rotation from the robot's own frame to that of the pose
        self._arrived_ns = self._clock_ns = 0
        self._sonar: dict[int, float] = {}

    def connect(self, robot: Robot) -> None:
        """A connection begins: the next packet is the new base."""
        self._robot, self._last = robot, None
        self._link += 1

    def add(self, sip: Sip, now_ns: int, stopped: str) -> Sample:
        """Sample of a packet that arrived now."""
        robot = self._robot
        self._clock_ns = self._sent_ns(now_ns)
        self._move(sip, now_ns)
        self._last, self._arrived_ns = sip, now_ns
        self._number += 1
        left, right = (1e-3 * robot.vel_factor * each for each in (sip.left, sip.right))
        # 0.1 deg/s if the packet has it, else from the wheels
        w = 1.7453292519943296e-3 * sip.rotation if sip.rotation is not None else (right - left) / robot.track_m
        for number, counts in sip.sonars:
            self._sonar[number] = 1e-3 * robot.range_factor * counts
        return Sample(
            number=self._number,
            link=self._link,
            arrived_ns=now_ns,
            measured_ns=self._clock_ns - AGE_NS,
            odometry=Odometry(pose=self._pose, v=0.5 * (left + right), w=w),
            wheels=(left, right),
            sonar=tuple(sorted(self._sonar.items())),
            battery_v=0.1 * (sip.battery if sip.battery_x10 is None else sip.battery_x10),
            motors=sip.motors_on,
            stalled=(sip.left_stalled, sip.right_stalled),
            bumpers=sip.stall & 0xFEFE,
            emergency_stop=bool(sip.flags & EMERGENCY_STOP),
            stopped=stopped,
        )

    def taken(self) -> None:
        """The newest sample was read: its sonar readings are not repeated."""
        self._sonar = {}

    def _move(self, sip: Sip, now_ns: int) -> None:
        """Add the difference of two packets to the pose."""
        last, robot = self._last, self._robot
        x, y, yaw = self._pose
        if last is None:
            self._turned = yaw - robot.angle_factor * sip.heading
            return
        dx, dy = (1e-3 * robot.dist_factor * _difference(*both, 1 << COUNT_BITS) for both in ((sip.x, last.x), (sip.y, last.y)))
        farthest = robot.max_speed * (1e-9 * (now_ns - self._arrived_ns) + LEAP_S)
        if dx * dx + dy * dy > farthest * farthest:
            self.leaps += 1
            self._turned = yaw - robot.angle_factor * sip.heading
            return
        dx, dy = rotate2(dx, dy, self._turned)
        self._pose = (x + dx, y + dy, yaw + robot.angle_factor * _difference(sip.heading, last.heading, HEADING_COUNTS))

    def _sent_ns(self, now_ns: int) -> int:
        """Time of sending, by the minimum delay: packets leave once a period, some arrive late, none early."""
        period = seconds_to_ns(self._robot.period_s)
        if self._last is None:
            return now_ns
        periods = max(1, round((now_ns - self._clock_ns) / period))
        return min(now_ns, self._clock_ns + round(periods * period * (1.0 + DRIFT)))  # at most half a period before now


def _difference(new: int, old: int, modulus: int) -> int:
    """Shortest difference of a counter that wraps."""
    return (new - old + modulus // 2) % modulus - modulus // 2
