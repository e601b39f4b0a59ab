"""Tracking of a target with an intermittent camera: confirmation, estimate, commanded velocity, and search.

Everything is in the plane, in the world frame: a picture says where the target was when it was taken (see
`agents.reconnaissance.ground_point`), so neither the heading of the vehicle nor its own motion matter here.

Properties of the loop (T the period, k the gain; a vehicle that follows commands exactly):

- the offset of a target at rest shrinks by 1 - kT a tick, at any heading;
- behind a target at speed v the vehicle lags by v/k, with ``smoothing`` 0: the estimated speed of the target removes this lag;
- where both the picture and the own position are n ticks old when the command takes effect, the offset follows
  ``e[i+1] = e[i] - kT e[i-n]``, which decays if and only if kT < 2 sin(pi / (2 (2n + 1))) (S. A. Kuruklis, The asymptotic
  stability of x(n+1) - a x(n) + b x(n-k) = 0, Journal of Mathematical Analysis and Applications 188, 1994). A picture that is
  late alone costs no stability, as long as it is seen from where it was taken.
"""

import math
from collections import deque
from collections.abc import Iterable
from typing import Literal

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.types import Vec3

Point = tuple[float, float]
Phase = Literal["none", "seen", "predicted", "spiral", "lost"]

GAIN = 0.8  # 1/s: speed towards the target for each metre
SMOOTHING = 0.2  # share of a new measurement in the estimated velocity, a tick
WITHIN_M = 2.0  # largest distance between detections of one target
TARGET_SPEED = 1.0  # m/s: a target out of sight has moved no faster
LOST_S, SPIRAL_S = 3.0, 10.0  # time without a detection until a target is lost; duration of the search after that


def largest_gain(latency_ticks: int, period_s: float) -> float:
    """Limit of stability: the gain, 1/s, at which a loop with a delay of so many ticks becomes unstable."""
    return 2.0 * math.sin(math.pi / (2 * (2 * latency_ticks + 1))) / period_s


def spiral(elapsed_s: float, speed: float, pitch_m: float, heading: float = 0.0) -> Point:
    """Point on an Archimedean spiral from (0, 0), m, begun ``elapsed_s`` ago in the direction ``heading``, rad.

    With a = pitch / 2 pi it is r = a phi, phi = sqrt(1 + 2 s/a) - 1 at s = ``speed`` times ``elapsed_s``: never faster than
    ``speed``, never slower than 0.7 of it, and its turns are ``pitch_m`` apart.
    """
    a = pitch_m / math.tau
    phi = math.sqrt(1.0 + 2.0 * speed * max(0.0, elapsed_s) / a) - 1.0
    return a * phi * math.cos(heading + phi), a * phi * math.sin(heading + phi)


class Confirmation:
    """Confirms a target by detections near one another in some of the last frames."""

    def __init__(self, needed: int = 3, frames: int = 5, within_m: float = WITHIN_M) -> None:
        self.needed, self.within_m = needed, within_m
        self._frames: deque[tuple[Point, ...]] = deque(maxlen=frames)

    def frame(self, places: Iterable[Point]) -> Point | None:
        """Add the detections of a frame; the place of a target that they and the previous frames confirm."""
        self._frames.append(tuple(place for place in places if _is_place(place)))
        for place in self._frames[-1]:
            if sum(self._is_near(place, frame) for frame in self._frames) >= self.needed:
                return place
        return None

    def _is_near(self, place: Point, detections: Iterable[Point]) -> bool:
        return any(math.dist(place, other) <= self.within_m for other in detections)


class Tracker:
    """Estimate of one target's place, and velocities to stay above it.

    A detection further than ``within_m``, and 1 m/s times the time out of sight, from where the target is expected is not it.
    The search time counts commands: it stops while another algorithm commands. `ValueError`: the gain is too large for this
    period and latency. `agents.reconnaissance.track.TrackTarget` explains the other arguments.
    """

    def __init__(
        self,
        period_s: float,
        *,
        latency_s: float = 0.0,
        gain: float = GAIN,
        smoothing: float = SMOOTHING,
        max_speed: float = 4.0,
        within_m: float = WITHIN_M,
        lost_s: float = LOST_S,
        spiral_s: float = SPIRAL_S,
        spiral_speed: float = 2.0,
        spiral_pitch_m: float = 4.0,
    ) -> None:
        most = largest_gain(math.ceil(latency_s / period_s - 1e-9), period_s)
        if not 0.0 < gain < most:
            loop = f"a period of {period_s:g} s and a latency of {latency_s:g} s"
            raise ValueError(f"gain = {gain:g} must lie between 0 and {most:.3f} 1/s with {loop}")
        self.period_s, self.gain, self.smoothing = period_s, gain, smoothing
        self.max_speed, self.within_m = max_speed, within_m
        self.spiral_s, self.spiral_speed, self.spiral_pitch_m = spiral_s, spiral_speed, spiral_pitch_m
        self._lost_ns = seconds_to_ns(lost_s)
        self._place: Point | None = None
        self.velocity: Point = (0.0, 0.0)  # m/s, of the target, as estimated
        self.seen_ns = 0  # time of the newest picture that shows it
        self._searched = 0  # ticks, since it was lost

    def begin(self, image_ns: int, place: Point) -> None:
        """Track a target at this place, m, assumed at rest, in place of the former one."""
        if not _is_place(place):
            raise ValueError(f"the place of a target must be finite, not {place}")
        self._place, self.velocity, self.seen_ns, self._searched = place, (0.0, 0.0), image_ns, 0

    def end(self) -> None:
        """Track nothing."""
        self._place = None

    def see(self, image_ns: int, places: Iterable[Point]) -> bool:
        """Add the detections of a picture; returns whether the target is among them.

        The target is the detection nearest to the expected place, if it is near enough. Pictures that are not newer than the
        last one that showed it are ignored.
        """
        if self._place is None or image_ns <= self.seen_ns:
            return False
        expected = self.predicted(image_ns)
        nearest = min((place for place in places if _is_place(place)), key=lambda each: math.dist(each, expected), default=None)
        if nearest is None or math.dist(nearest, expected) > self.reach_m(image_ns):
            return False
        passed_s = (image_ns - self.seen_ns) / 1e9
        share = 1.0 - (1.0 - self.smoothing) ** (passed_s / self.period_s)
        (x, y), (vx, vy) = self._place, self.velocity
        velocity = (nearest[0] - x) / passed_s, (nearest[1] - y) / passed_s
        self.velocity = vx + share * (velocity[0] - vx), vy + share * (velocity[1] - vy)
        self._place, self.seen_ns, self._searched = nearest, image_ns, 0
        return True

    def phase(self, now_ns: int) -> Phase:
        """Phase of tracking: target in sight, predicted, searched, given up, or none."""
        if self._place is None:
            return "none"
        if now_ns - self.seen_ns < self._lost_ns:
            return "predicted" if now_ns - self.seen_ns > 1.5 * self.period_s * 1e9 else "seen"
        return "spiral" if self._searched * self.period_s < self.spiral_s - 1e-9 else "lost"

    def predicted(self, now_ns: int) -> Point:
        """Expected place of the target, m; of a lost target, its last seen place."""
        if self._place is None:
            raise ValueError("no target is tracked: call begin first")
        age_ns = now_ns - self.seen_ns
        age_s = age_ns / 1e9 if age_ns < self._lost_ns else 0.0
        return self._place[0] + age_s * self.velocity[0], self._place[1] + age_s * self.velocity[1]

    def reach_m(self, now_ns: int) -> float:
        """Radius of the region of interest around the expected place, m."""
        return self.within_m + TARGET_SPEED * max(0.0, (now_ns - self.seen_ns) / 1e9)

    def command(self, now_ns: int, position: Vec3) -> Point:
        """Velocity, m/s, world, for a vehicle at ``position``; (0, 0) without a target.

        ``k offset + v_target``, and on the search ``k offset`` from a point that moves on the spiral, at most ``max_speed``.
        """
        phase = self.phase(now_ns)
        if phase in ("none", "lost"):
            return 0.0, 0.0
        (x, y), (vx, vy) = self.predicted(now_ns), self.velocity
        if phase == "spiral":
            heading = math.atan2(vy, vx)  # its direction when it was last seen
            times_s = (ticks * self.period_s for ticks in (self._searched, self._searched + 1))
            now, then = (spiral(time_s, self.spiral_speed, self.spiral_pitch_m, heading) for time_s in times_s)
            x, y = x + now[0], y + now[1]
            vx, vy = (then[0] - now[0]) / self.period_s, (then[1] - now[1]) / self.period_s
            self._searched += 1
        vx, vy = vx + self.gain * (x - position[0]), vy + self.gain * (y - position[1])
        share = self.max_speed / speed if (speed := math.hypot(vx, vy)) > self.max_speed else 1.0
        return share * vx, share * vy


def _is_place(place: Point) -> bool:
    return math.isfinite(place[0]) and math.isfinite(place[1])
