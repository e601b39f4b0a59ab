"""Protocol of a physics engine.

Vehicles are rows of arrays; there is no object per vehicle. An engine is constructed with the world, the models
(`physics.vehicles.models`), start positions and headings, and its step rate if it has one. Another engine (e.g. MuJoCo) needs

* bodies from the models' parameters, from ``World.mesh()``, movables and the time-tables of moving obstacles;
* ground robots: one call of `physics.dynamics.firmware` a step, which returns the wheel speeds to hold;
* quadrotors: force and torque of `physics.dynamics.quadrotor_fleet.QuadrotorFleet`, with arrays that the engine updates;
* the same bits from the same calls, independent of the order of a set, of other engines, and of the number of reads.
"""

from typing import NamedTuple, Protocol

import numpy as np

from vcmvsp.cosim.types import Array, Vec3


class BodyMotion(NamedTuple):
    """Motion of n bodies at one instant; the arrays never change."""

    position: Array  # (n, 3) m, world, of the reference points
    velocity: Array  # (n, 3) m/s, world
    attitude: Array  # (n, 4) w, x, y, z; world_from_body
    angular_velocity: Array  # (n, 3) rad/s, body
    acceleration: Array  # (n, 3) m/s2, world, mean over the engine's last step
    wheels: Array  # (n, 2) rad, turns of the left and right wheel; NaN without wheels
    odometry: Array  # (n, 5) x m, y m, yaw rad, v m/s, w rad/s, of the wheels; NaN without wheels


WIDTHS = (3, 3, 4, 3, 3, 2, 5)
"""Of the arrays of a `BodyMotion`."""


class Touch(NamedTuple):
    """Contact of two bodies, or of a body and a solid, with a force. The floor does not count."""

    row: int  # a vehicle
    other: int | None  # another vehicle, of a greater row; n + k: the k-th movable, then the k-th obstacle; None: a solid
    place: Vec3  # m, world

    @property
    def key(self) -> tuple[int, int]:
        """Sort key."""
        return self.row, -1 if self.other is None else self.other


class Engine(Protocol):
    """Moves vehicles and the movables that they push."""

    stepped: bool  # it has steps of its own: many short advances give the same bits as one long one

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Set a velocity, m/s, in the body frame on the ground and the world frame in the air, and a yaw rate, rad/s."""

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Fly to a position, m, and hover there with ``yaw``, rad, at ``speed``, m/s, at most; never on the ground.

        ``yaw`` None: the present heading. ``speed`` None: the vehicle's greatest.
        """

    def advance(self, to_ns: int) -> None:
        """Advance to ``to_ns``."""

    def read(self) -> BodyMotion:
        """Motion of every vehicle. Reading changes nothing."""

    def movables(self) -> BodyMotion:
        """Motion of every movable; no rows if the engine cannot push them."""

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable at rest, its centre at ``place``, m, upright, turned by ``yaw`` rad."""

    def touching(self, *, passing: bool) -> list[Touch]:
        """Present contacts by rows; with ``passing`` also contacts that ended since the last call with ``passing``."""

    def close(self) -> None:
        """Release all resources."""


def side_by_side(*columns: Array) -> Array:
    """Columns (n,) as one array (n, k); `numpy.column_stack` takes three times as long."""
    return np.array(columns).T.copy()


def without_wheels(position: Array, velocity: Array, attitude: Array, spin: Array, acceleration: Array) -> BodyMotion:
    """Motion of bodies without wheels; arrays and units as in `BodyMotion`."""
    n = len(position)
    return BodyMotion(position, velocity, attitude, spin, acceleration, np.full((n, 2), np.nan), np.full((n, 5), np.nan))


def still(position: Array, heading: Array) -> BodyMotion:
    """Bodies at rest: positions (n, 3) m, headings (n,) rad."""
    attitude = np.zeros((len(position), 4))
    attitude[:, 0], attitude[:, 3] = np.cos(0.5 * heading), np.sin(0.5 * heading)
    zero = np.zeros((len(position), 3))
    return without_wheels(position, zero, attitude, zero, zero)


NO_BODIES = still(np.empty((0, 3)), np.empty(0))


class Bodiless:
    """Base of engines without bodies: nothing collides."""

    stepped = False

    def movables(self) -> BodyMotion:
        """No movable can be pushed."""
        return NO_BODIES

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """No effect: there are no movables."""

    def touching(self, *, passing: bool) -> list[Touch]:
        """No contacts."""
        return []

    def close(self) -> None:
        """Nothing to release."""


def gathered(parts: "list[tuple[BodyMotion, Array]]", count: int) -> BodyMotion:
    """Motion of ``count`` vehicles from several engines, each with the rows (k,) of its vehicles; read-only."""
    if len(parts) == 1 and len(parts[0][1]) == count:
        whole = parts[0][0]  # one engine has all rows, in order
    else:
        whole = BodyMotion(*(np.full((count, width), np.nan) for width in WIDTHS))
        for motion, rows in parts:
            for target, source in zip(whole, motion, strict=True):
                target[rows] = source
    for array in whole:
        array.setflags(write=False)
    return whole
