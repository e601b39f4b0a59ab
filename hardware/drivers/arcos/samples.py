"""Samples of information packets: pose from counters that wrap, speeds, sonars, flags, and when it was measured."""

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Odometry, Vec3
from vcmvsp.hardware.drivers.arcos.robot_parameters import Robot
from vcmvsp.hardware.drivers.arcos.sip import COUNT_BITS, Sip
from vcmvsp.hardware.drivers.base import Sample

HEADING_COUNTS = 4096  # a turn
EMERGENCY_STOP = 1 << 5  # of the flags, in ARCOS: the button is pressed
AGE_NS = 50_000_000  # half a packet period: the packets carry no time, and what they tell is up to one period old
DRIFT = 0.01  # by which the robot's period may differ from the nominal one
LEAP_S = 1.0  # a step of the pose is believed up to what the greatest speed covers in the time since the last packet and this


class ArcosSampler:
    """What a robot's packets say, from the pose at which it was when the first one came; over reconnections, too.

    Attributes:
        leaps: steps of the pose that no robot can make, and that were left out: somebody set its odometry.
    """

    def __init__(self, start: Vec3) -> None:
        self.leaps = 0
        self._pose = start
        self._number = self._link = 0
        self._last: Sip | None = None
        self._turned = 0.0  # from the robot's own frame to that of the pose
        self._arrived_ns = self._clock_ns = 0
        self._sonar: dict[int, float] = {}

    def connect(self, robot: Robot) -> None:
        """A connection begins: the next packet is the base of what follows."""
        self._robot, self._last = robot, None
        self._link += 1

    def add(self, sip: Sip, now_ns: int, stopped: str) -> Sample:
        """The sample of a packet that arrived now."""
        robot = self._robot
        self._clock_ns = self._sent_ns(now_ns)
        self._move(sip, now_ns)
        self._last, self._arrived_ns = sip, now_ns
        self._number += 1
        left, right = (1e-3 * robot.vel_factor * each for each in (sip.left, sip.right))
        # 0.1 deg/s where it is told, else from the wheels
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
        """The newest sample was read: later ones need not repeat its sonars."""
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
        """When the packet was sent, as a filter of least delay: packets leave once a period, some arrive late, none early."""
        period = seconds_to_ns(self._robot.period_s)
        if self._last is None:
            return now_ns
        periods = max(1, round((now_ns - self._clock_ns) / period))
        return min(now_ns, self._clock_ns + round(periods * period * (1.0 + DRIFT)))  # at most half a period before now


def _difference(new: int, old: int, modulus: int) -> int:
    """The shortest way round a counter that wraps."""
    return (new - old + modulus // 2) % modulus - modulus // 2
