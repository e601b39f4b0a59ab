"""Interface of a method of avoidance: a `Task` and a `View` in, a `Decision` out; and the keys of ``avoidance = {...}``.

A method has no access to scenario, radio and clock. Speed limits near obstacles (`agents.avoidance.steering`) and invalid scans
are handled outside. All values are in the body frame, x forward, y left. Ground vehicles move along x only: their velocities
have y = 0. A user-defined method::

    class Stop:
        def __init__(self, body, distance: float = 0.5):
            self.distance = distance + body.radius_m

        def decide(self, view, task):
            if view.nearest_m < self.distance:
                return Decision((0.0, 0.0), 0.0, "avoid")
            return Decision(task.velocity, task.yaw_rate, "task")

    avoidance = { kind = "own", algorithm = "stop.py:Stop", params = { distance = 0.3 } }
"""

import math
from collections.abc import Callable
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, Protocol

import msgspec

from vcmvsp.agents.avoidance.view import Point, View
from vcmvsp.cosim.agent import Body, VehicleInfo
from vcmvsp.cosim.config.binding import call, parameters
from vcmvsp.cosim.config.registry import find
from vcmvsp.cosim.types import Positive

Mode = Literal["task", "avoid", "turn", "blind"]


class Task(NamedTuple):
    """Intended motion of the vehicle without obstacles."""

    velocity: Point  # m/s
    yaw_rate: float = 0.0  # rad/s
    aim: Point | None = None  # m: destination; None: none, it roams
    leader: Point | None = None  # m: estimated position of the leader
    max_speed: float = 0.6  # m/s: limit on the way around an obstacle
    now: tuple[float, float] = (0.0, 0.0)  # m/s ahead, rad/s: last command, after all limits


class Decision(NamedTuple):
    """Motion that a method has decided on."""

    velocity: Point  # m/s
    yaw_rate: float  # rad/s
    mode: Mode  # "task": as the task says; "avoid": another way; "turn": on the spot, without a free way; "blind": stand


class Method(Protocol):
    """A method of avoidance: one object per vehicle, called once a tick, with its own state."""

    def decide(self, view: View, task: Task) -> Decision:
        """Decide on the motion of a tick."""


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """Parameters of all methods."""

    REACH: ClassVar[str] = "reach"  # the key of the distance from which on things matter to the method

    scanner: str = "scan"  # name of the range scanner that it looks at
    keep_m: Positive | None = None  # what it keeps away from everything, from its reference point; default: of the method
    max_speed: Positive = 0.6  # m/s, on its way around something
    level: Annotated[int, msgspec.Meta(ge=1, le=2)] = 2  # 1: no limit of the speed near obstacles
    approach: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.4  # 1/s: speed towards something per distance left, at level 2
    braking: Positive = 0.3  # m/s2 that the vehicle can do for sure: how far ahead level 2 begins
    stale_s: Positive = 0.5  # a scan older than that is none: more than the period of the scanner

    def clearance_m(self, body: Body) -> float:
        """Distance to keep from all obstacles, m from the reference point."""
        return self.keep_m if self.keep_m is not None else self.default_keep_m(body)

    def default_keep_m(self, body: Body) -> float:
        """Default of ``keep_m``: the body and 5 cm."""
        return body.radius_m + 0.05

    @property
    def reach_m(self) -> float:
        """Distance at which the method first considers obstacles, m: level 1."""
        return float(getattr(self, self.REACH))

    def method(self, body: Body, period_s: float) -> Method:
        """A method of this kind for a vehicle with a period of ``period_s`` seconds."""
        raise NotImplementedError

    def maker(self) -> Callable[[Body, float], Method]:
        """Factory of methods; loaded when the agent is built, before its vehicle is known."""
        return self.method


class Own(Settings, frozen=True, kw_only=True, tag="own"):
    """A user-defined method."""

    algorithm: str  # module:Class or file.py:Class with a method decide(view, task)
    params: dict[str, Any] = msgspec.field(default_factory=dict)  # of its constructor; body and period_s come by themselves
    reach: Positive = 1.2  # m: what is nearer counts as an obstacle, in what is recorded

    def maker(self) -> Callable[[Body, float], Method]:
        """Look up the class at once, while the folder of its file is known."""
        factory = find("avoidance", self.algorithm, key="avoidance.algorithm")

        def make(body: Body, period_s: float) -> Method:
            offered = {"body": body, "period_s": period_s}
            params = {name: value for name, value in offered.items() if name in parameters(factory)}
            return call(factory, self.params, key="avoidance.params", arguments=params)

        return make


def saturated(velocity: Point, max_speed: float) -> Point:
    """Velocity limited to ``max_speed``, m/s, in the same direction."""
    speed = math.hypot(*velocity)
    return velocity if speed <= max_speed else (velocity[0] * max_speed / speed, velocity[1] * max_speed / speed)


def body_of(info: VehicleInfo) -> Body:
    """Body of a vehicle; `ValueError`: it is unknown."""
    if info.body is None:
        raise ValueError(f"avoidance needs the size of {info.name}, but its kind has no body; choose another kind of vehicle")
    return info.body
