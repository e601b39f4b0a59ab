"""Parameters of the robots that speak the protocol. Lengths in metres, as the vehicle's; factors are of the line's counts.

Sources: robot parameter files p2dx.p, amigo.p, amigo-sh.p of ARIA and robot parameters of Player, which agree; initial speeds
and accelerations of the firmware are from MobileSim; angular accelerations are assumed.
"""

import math
from typing import Literal

import msgspec

Kind = Literal["p2dx", "amigo", "amigo-sh"]


class Sonar(msgspec.Struct, frozen=True):
    """Place and direction of a sonar in the robot's frame (x forward, y left)."""

    x: float  # m
    y: float  # m
    angle: float  # rad


class Robot(msgspec.Struct, frozen=True, kw_only=True):
    """A kind of robot.

    Factors convert counts of information packets to mm and mm/s; commands are in mm/s and deg/s. ``diff_factor`` is
    2 / effective track in mm: a turn on the spot makes the wheels of a skidding robot go further than the true track says.
    """

    name: str
    kind: Kind  # subclass that the robot reports on connection; clients choose parameters by it
    radius_m: float
    max_speed: float  # m/s, more is never done
    max_yaw_rate: float  # rad/s
    speed: float  # m/s, limit of the firmware until SETV
    yaw_rate: float  # rad/s, until SETRV
    accel: float  # m/s2, until SETA
    decel: float  # m/s2
    yaw_accel: float  # rad/s2, until SETRA
    dist_factor: float  # mm per count of x and y
    vel_factor: float  # mm/s per count of wheel speed
    range_factor: float  # mm per count of a sonar's range
    diff_factor: float  # rad per mm of the wheels' difference / 2
    angle_factor: float = 2.0 * math.pi / 4096  # rad per count of heading
    vel2_divisor: float = 20.0  # mm/s per count of VEL2
    watchdog_s: float = 2.0  # without a command, the robot stops
    period_s: float = 0.1  # from information packet to information packet
    baud: int = 9600  # 8N1
    sonar_max_m: float = 5.0  # reading of a sonar without an echo
    sonars: tuple[Sonar, ...]

    @property
    def track_m(self) -> float:
        """Effective track, m."""
        return 2e-3 / self.diff_factor


def _ring(*places: tuple[int, int, int], mirrored: bool = True) -> tuple[Sonar, ...]:
    """Sonars at (x mm, y mm, degrees); ``mirrored``: then their mirror images in reverse order, as numbered on the robot."""
    if mirrored:
        places += tuple((x, -y, -degrees) for x, y, degrees in reversed(places))
    return tuple(Sonar(x / 1000, y / 1000, math.radians(degrees)) for x, y, degrees in places)


_P2DX = Robot(
    name="Pioneer 2-DX",
    kind="p2dx",
    radius_m=0.250,
    max_speed=2.2,
    max_yaw_rate=math.radians(500),
    speed=0.75,
    yaw_rate=1.74,
    accel=0.3,
    decel=0.6,
    yaw_accel=math.radians(100),
    dist_factor=0.84,
    vel_factor=1.0,
    range_factor=0.268,
    diff_factor=0.0056,
    sonars=_ring((69, 136, 90), (114, 119, 50), (148, 78, 30), (166, 27, 10))
    + _ring((-157, -136, -90), (-203, -119, -130), (-237, -78, -150), (-255, -27, -170)),
)
_AMIGO = msgspec.structs.replace(
    _P2DX,
    name="AmigoBot",
    kind="amigo",
    radius_m=0.180,
    max_speed=1.0,
    max_yaw_rate=math.radians(300),
    speed=0.5,
    yaw_rate=0.87,
    decel=0.75,
    dist_factor=0.5083,
    vel_factor=0.6154,
    range_factor=1.0,  # ARIA's; the AmigoBot manual of 2002 says 0.555
    diff_factor=0.011,
    sonars=_ring((76, 100, 90), (125, 75, 41), (150, 30, 15)) + _ring((-140, -58, -145)),
)
_AMIGO_SH = msgspec.structs.replace(
    _AMIGO,
    name="AmigoBot SH",
    kind="amigo-sh",
    speed=0.75,
    dist_factor=1.0,
    vel_factor=1.0,
    sonars=_ring((70, 100, 90), (125, 75, 41), (144, 30, 15), (144, -30, -15), (120, -75, -41), (70, -100, -90), mirrored=False)
    + _ring((-146, -58, -145)),
)

ROBOTS: dict[str, Robot] = {each.kind: each for each in (_P2DX, _AMIGO, _AMIGO_SH)}
