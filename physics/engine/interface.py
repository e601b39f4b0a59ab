"""What the physics federate asks of an engine. Bullet and plain kinematics are two; another would fit behind the same verbs.

Vehicles are rows, in the order in which the engine was given them; an engine takes and gives numbers and arrays of all rows,
and no object per vehicle. It is built with what it moves: the world, the models (`physics.vehicles.models`), start positions
and headings, and a rate of its own if it has one. A third engine (MuJoCo, say) would need

* to build its bodies from the models' parameters and from ``World.mesh()``, movables and the time-tables of moving obstacles;
* firmware and motors of ground robots: `physics.dynamics.firmware` gives the speeds to hold, and is an engine's to call once a
step;
* the force and torque on every quadrotor: `physics.dynamics.quadrotor_fleet.Fleet` gives them from its arrays, which the engine
keeps up to date;
* the same bits from the same calls: nothing may depend on the order of a set, on other engines, or on how often it is read.
"""

from typing import NamedTuple, Protocol

import numpy as np

from vcmvsp.cosim.types import Array, Vec3


class Motion(NamedTuple):
    """How n bodies move at one instant; arrays that nobody writes to any more."""

    position: Array  # (n, 3) m, world, of the reference points
    velocity: Array  # (n, 3) m/s, world
    attitude: Array  # (n, 4) w, x, y, z; world_from_body
    angular_velocity: Array  # (n, 3) rad/s, body
    acceleration: Array  # (n, 3) m/s2, world, mean over the engine's last step
    wheels: Array  # (n, 2) rad, how far the left and right wheel have turned; NaN without wheels
    odometry: Array  # (n, 5) x m, y m, yaw rad, v m/s, w rad/s, as the wheels say; NaN for what does not drive


WIDTHS = (3, 3, 4, 3, 3, 2, 5)
"""Of the arrays of a `Motion`."""


class Touch(NamedTuple):
    """Two bodies that press against each other, or one against the world. Touching the floor does not count."""

    row: int  # a vehicle
    other: int | None  # another vehicle, of a greater row; n + k: the k-th movable, then the k-th obstacle; None: a solid
    place: Vec3  # m, world

    @property
    def key(self) -> tuple[int, int]:
        """Who touches what, for sorting."""
        return self.row, -1 if self.other is None else self.other


class Engine(Protocol):
    """Moves some vehicles, and what they push about."""

    stepped: bool  # it has steps of its own: moving on in many parts gives the same bits as in one

    def command(self, row: int, linear: Vec3, yaw_rate: float) -> None:
        """Move like this from now on: m/s in the body frame on the ground, in the world frame in the air; rad/s."""

    def go_to(self, row: int, position: Vec3, yaw: float | None, speed: float | None) -> None:
        """Fly to this place from now on, m, and stay there, turned to ``yaw``, rad; at most at ``speed``, m/s.

        None leaves the heading as it is, and the speed to the vehicle. Vehicles on the ground are never asked.
        """

    def advance(self, to_ns: int) -> None:
        """Move on to ``to_ns``."""

    def read(self) -> Motion:
        """How every vehicle moves now. Reading changes nothing."""

    def movables(self) -> Motion:
        """How every movable of the world moves now: no rows where nothing can push them."""

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """Put a movable somewhere, with its centre there, m, upright and turned by ``yaw`` rad: it is at rest from now on."""

    def touching(self, *, passing: bool) -> list[Touch]:
        """What touches now, by rows: asking changes nothing.

        With ``passing`` also what has touched since that was last asked for, if an engine notices.
        """

    def close(self) -> None:
        """Release everything."""


def side_by_side(*columns: Array) -> Array:
    """Columns (n,) as one array (n, k); `numpy.column_stack` takes three times as long."""
    return np.array(columns).T.copy()


def still(position: Array, heading: Array) -> Motion:
    """Bodies that stand: positions (n, 3) m, headings (n,) rad."""
    n = len(position)
    attitude = np.zeros((n, 4))
    attitude[:, 0], attitude[:, 3] = np.cos(0.5 * heading), np.sin(0.5 * heading)
    zero = np.zeros((n, 3))
    return Motion(position, zero, attitude, zero, zero, np.full((n, 2), np.nan), np.full((n, 5), np.nan))


NO_BODIES = still(np.empty((0, 3)), np.empty(0))


class Bodiless:
    """What engines have in common that move vehicles without bodies: nothing collides."""

    stepped = False

    def movables(self) -> Motion:
        """Nothing here can push anything."""
        return NO_BODIES

    def put(self, number: int, place: Vec3, yaw: float) -> None:
        """There is nothing to be put."""

    def touching(self, *, passing: bool) -> list[Touch]:
        """No bodies, no contacts."""
        return []

    def close(self) -> None:
        """Nothing to release."""


def gathered(parts: "list[tuple[Motion, Array]]", count: int) -> Motion:
    """The rows of several engines as one, read-only: each with the places (k,) that its rows have among ``count``."""
    if len(parts) == 1 and len(parts[0][1]) == count:
        whole = parts[0][0]  # one engine has all, in order
    else:
        whole = Motion(*(np.full((count, width), np.nan) for width in WIDTHS))
        for motion, rows in parts:
            for target, source in zip(whole, motion, strict=True):
                target[rows] = source
    for array in whole:
        array.setflags(write=False)
    return whole
