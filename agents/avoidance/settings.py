"""Common keys of ``avoidance = {...}``: scanner, distance to keep, speed limit."""

from collections.abc import Callable
from typing import Annotated

import msgspec

from vcmvsp.agents.avoidance.method import Method
from vcmvsp.cosim.agent import Body, VehicleInfo
from vcmvsp.cosim.types import Positive


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind"):
    """What all methods have in common."""

    scanner: str = "scan"  # name of the range scanner that it looks at
    keep_m: Positive | None = None  # what it keeps away from everything, from its reference point; default: of the method
    max_speed: Positive = 0.6  # m/s, on its way around something
    level: Annotated[int, msgspec.Meta(ge=1, le=2)] = 2  # 1: no limit of the speed near obstacles
    approach: Annotated[float, msgspec.Meta(gt=0, le=10)] = 0.4  # 1/s: speed towards something per distance left, at level 2
    braking: Positive = 0.3  # m/s2 that the vehicle can do for sure: how far ahead level 2 begins
    stale_s: Positive = 0.5  # a scan older than that is none: more than the period of the scanner

    def kept_m(self, body: Body) -> float:
        """What it keeps away from everything, m from its reference point."""
        return self.keep_m if self.keep_m is not None else self.default_keep_m(body)

    def default_keep_m(self, body: Body) -> float:
        """The body, and 5 cm."""
        return body.radius_m + 0.05

    @property
    def reach_m(self) -> float:
        """From how near on things matter to the method, m: level 1."""
        raise NotImplementedError

    def method(self, body: Body, period_s: float) -> Method:
        """A method of this kind for a vehicle with a period of ``period_s`` seconds."""
        raise NotImplementedError

    def maker(self) -> Callable[[Body, float], Method]:
        """Factory of methods; loaded when the agent is built, before its vehicle is known."""
        return self.method


def body_of(info: VehicleInfo) -> Body:
    """The space that a vehicle takes up.

    Raises:
        ValueError: the vehicle has no known body.
    """
    if info.body is None:
        raise ValueError(f"avoidance needs to know how much room {info.name} takes, and nobody says: there is no body")
    return info.body
