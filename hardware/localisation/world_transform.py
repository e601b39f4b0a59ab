"""Transform of positions into the world and to this machine's clock, with checks."""

import math
from collections.abc import Callable

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.estimation.clock_offset import ForeignClock
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Fix, NonNegative, Positive, Vec3
from vcmvsp.hardware.localisation import Located

FARTHEST_M = 10_000.0  # from the world's origin; beyond, the frame is wrong
OLDEST_S = 10.0  # older positions are useless; a clock that stands still gives such times
MOST_TAGS = 64  # of one system
LEAST_SIGMA_M = LEAST_SIGMA_RAD = 1e-3  # minimum standard deviations
AT_REST: Vec3 = (0.0, 0.0, 0.0)


class LocatedPose(Located, frozen=True, kw_only=True):
    """An answer with a heading."""

    yaw: float | None = None  # rad
    sigma_rad: float = 0.0  # standard deviation of the yaw; not positive: the yaw is unknown


class WorldTransform:
    """Transforms positions of one tag.

    Args:
        tag: tag of the vehicle; empty: any.
        sigma_m: standard deviation if a message has none.
        latency_s: minimum delay from measurement to arrival.
        offset: origin of the system's frame in the world, m.
        turn_rad: rotation of its frame in the world, counter-clockwise.
        normal: normal form of a tag's name.
    """

    def __init__(
        self,
        *,
        tag: str = "",
        sigma_m: Positive,
        latency_s: NonNegative,
        offset: Vec3 = AT_REST,
        turn_rad: float = 0.0,
        normal: Callable[[str], str] = str.upper,
    ) -> None:
        if not all(map(math.isfinite, (*offset, turn_rad))):
            raise ValueError(f"offset and turn_rad must be finite, not {offset} and {turn_rad}")
        self._normal, self.tag = normal, normal(tag)
        self._sigma_m, self._offset, self._turn = sigma_m, offset, turn_rad
        self._cosine, self._sine = math.cos(turn_rad), math.sin(turn_rad)
        self._latency_s = latency_s
        self._clocks: dict[str, ForeignClock] = {}  # by tag: messages of two tags may come in any order
        self.tags: set[str] = set()  # tags in messages so far
        self.unknown = self.far = self.old = self.others = 0  # rejected: without a position, too far, too old, of other tags

    @property
    def jumps(self) -> int:
        """Number of jumps of the system's clock."""
        return sum(each.jumps for each in self._clocks.values())

    def place(self, located: Located, arrived_ns: int) -> Fix | None:
        """Position in the world; None if it is rejected."""
        tag = self._normal(located.tag)
        if tag and len(self.tags) < MOST_TAGS:
            self.tags.add(tag)
        if tag and (tag != self.tag if self.tag else tag not in self.tags):
            self.others += 1
            return None
        time_ns = self._time(located, tag, arrived_ns)
        sigma_m = located.sigma_m if located.sigma_m is not None and math.isfinite(located.sigma_m) else 0.0
        if located.position is None or sigma_m > FARTHEST_M:
            self.unknown += 1
            return None
        x, y, z = located.position
        placed = (
            self._offset[0] + self._cosine * x - self._sine * y,
            self._offset[1] + self._sine * x + self._cosine * y,
            self._offset[2] + z,
        )
        if not math.hypot(*placed) <= FARTHEST_M:  # true for NaN
            self.far += 1
            return None
        if time_ns < arrived_ns - seconds_to_ns(OLDEST_S):
            self.old += 1
            return None
        yaw, sigma_rad = self._heading(located) if isinstance(located, LocatedPose) else (None, 0.0)
        sigma_m = max(sigma_m or self._sigma_m, LEAST_SIGMA_M)
        return Fix(time_ns=time_ns, position=placed, yaw=yaw, sigma_m=sigma_m, sigma_rad=sigma_rad)

    def _heading(self, posed: LocatedPose) -> tuple[float | None, float]:
        """Yaw in the world and its standard deviation, if they are usable."""
        if posed.yaw is None or not math.isfinite(posed.yaw) or not 0.0 < posed.sigma_rad <= math.pi:
            return None, 0.0
        return wrap(posed.yaw + self._turn), max(posed.sigma_rad, LEAST_SIGMA_RAD)

    def _time(self, located: Located, tag: str, arrived_ns: int) -> int:
        """Time of the measurement; a clock at zero counts as none."""
        if not located.source_ns:
            return arrived_ns - seconds_to_ns(self._latency_s)
        if tag not in self._clocks:
            self._clocks[tag] = ForeignClock(least_s=self._latency_s)
        return self._clocks[tag].heard(located.source_ns, arrived_ns)
