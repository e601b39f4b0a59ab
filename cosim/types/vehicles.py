"""Where vehicles are, how they are to move, and what befalls them and what they touch."""

from typing import Literal

from vcmvsp.cosim.frames import Quaternion, yaw_of
from vcmvsp.cosim.types.quantities import Array, Value, Vec3


class VehicleState(Value, frozen=True, kw_only=True, tag="state"):
    """A rigid body at one instant."""

    position: Vec3  # m, world
    velocity: Vec3 = (0.0, 0.0, 0.0)  # m/s, world
    attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)  # w, x, y, z; world_from_body; unit norm
    angular_velocity: Vec3 = (0.0, 0.0, 0.0)  # rad/s, body

    @property
    def yaw(self) -> float:
        """Direction of the body x axis seen from above, rad, counter-clockwise from east."""
        return yaw_of(self.attitude)


class States(Value, frozen=True, kw_only=True, tag="states"):
    """The true states of all vehicles at one instant, a row per vehicle (for the radio and the recording only)."""

    names: tuple[str, ...]
    position: Array  # (n, 3) m, world
    velocity: Array  # (n, 3) m/s, world
    attitude: Array  # (n, 4) w, x, y, z; world_from_body
    angular_velocity: Array  # (n, 3) rad/s, body


class Velocity(Value, frozen=True, kw_only=True, tag="velocity"):
    """A command: move like this until the next command.

    ``linear`` is in the body frame for ground robots (x forward; they cannot follow y and z) and in the world frame for
    vehicles that fly.
    """

    linear: Vec3 = (0.0, 0.0, 0.0)  # m/s
    yaw_rate: float = 0.0  # rad/s


class Waypoint(Value, frozen=True, kw_only=True, tag="waypoint"):
    """A command to a vehicle that flies: go there and stay, until the next command."""

    position: Vec3  # m, world
    yaw: float | None = None  # rad; None: keep the present one
    speed: float | None = None  # m/s; None: as fast as its autopilot goes


class Contact(Value, frozen=True, kw_only=True, tag="contact"):
    """A vehicle began to touch another vehicle, a movable or moving obstacle or, where ``other`` is None, the world."""

    vehicle: str
    other: str | None


class Pushed(Value, frozen=True, kw_only=True, tag="pushed"):
    """Where obstacles are that can be pushed; those that nobody has touched, too."""

    names: tuple[str, ...]
    position: Array  # (n, 3) m, world, of their centres
    attitude: Array  # (n, 4) w, x, y, z; world_from_body


class Presence(Value, frozen=True, kw_only=True, tag="presence"):
    """What became of a vehicle's agent: it was lost and its vehicle holds, was lost for good, or is back."""

    state: Literal["lost", "removed", "back"]
    since_ns: int  # its first tick without an answer, or its first with one again
    why: str = ""
    late: int = 0  # back: answers that came too late to count


class RealStatus(Value, frozen=True, kw_only=True, tag="real"):
    """How a real vehicle and the run that it is part of stand, at an instant of the run."""

    link: int  # which connection since the start: greater than 1 after one was lost
    age_s: float | None  # of the newest that its driver told; None: nothing yet
    fix_age_s: float | None = None  # of the newest position that counted
    sigma_m: float | None = None  # standard deviation of the estimated position, along its worse axis
    prediction_m: float | None = None  # how far off dead reckoning since the last instant was
    gated: int = 0  # positions that did not fit, so far
    sent: Velocity | None = None  # what the robot was told last
    causes: tuple[str, ...] = ()  # why that is not what its agent wanted
    battery_v: float | None = None
    bumpers: int = 0  # a bit for each segment that is pressed
    late_s: float = 0.0  # how late a turn of its station began, at most, since the last instant


class Incident(Value, frozen=True, kw_only=True, tag="incident"):
    """Something that befell a real vehicle."""

    what: Literal["connected", "lost", "stopped", "warned"]
    cause: str
    happened_ns: int  # in the run's time; may lie before 0
