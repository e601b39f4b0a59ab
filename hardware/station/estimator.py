"""State of a robot at any instant, from the newest samples of its driver and its localisation.

Between samples the state is extrapolated for a limited time, then the robot stands (`cosim.estimation.dead_reckoning`).
"""

import math
from typing import TYPE_CHECKING, Any

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.estimation.dead_reckoning import LONGEST_NS, ahead, planar
from vcmvsp.cosim.frames import travelled, wrap
from vcmvsp.cosim.types import Array, Fix, Vec3, VehicleState
from vcmvsp.hardware.drivers.base import Sample

if TYPE_CHECKING:
    from vcmvsp.cosim.estimation.fusion import Fusion


class StateEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """State at an instant."""

    state: VehicleState
    covariance: Array | None = None  # (3, 3) of x, y, yaw
    measured_ns: int | None = None  # time of the measurement; None: none yet
    fix_age_s: float | None = None


class DriverEstimator:
    """State as the driver reports it; odometry if it reports none, but not for a vehicle that flies.

    Samples and fixes come in order of arrival; their times must not lie in the future.
    """

    def __init__(self, height_m: float, *, flies: bool) -> None:
        self.gated = self.jumps = 0
        self._height_m, self._flies = height_m, flies
        self._last: Sample | None = None

    def sample(self, sample: Sample, now_ns: int) -> None:
        """Take a sample of the driver; the newest counts."""
        self._last = sample

    def fix(self, fix: Fix) -> None:
        """Positions of another system are ignored."""

    def at(self, now_ns: int) -> StateEstimate | None:
        """The state now; None: unknown."""
        last = self._last
        if last is None or (last.state is None and self._flies):
            return None
        measured_ns = min(last.measured_ns, now_ns)
        state = last.state or planar(last.odometry.pose, last.odometry.v, last.odometry.w, self._height_m)
        return StateEstimate(state=ahead(state, now_ns - measured_ns, flies=self._flies), measured_ns=measured_ns)


class FusedEstimator:
    """Fuses odometry and positions.

    While the heading is unknown (no start, or after a restart), odometry gives it, rotated as when the heading was last known:
    a robot that stands would never get one. ``gated`` counts rejected fixes, ``jumps`` restarts from them.
    """

    def __init__(self, fusion: dict[str, Any], start: Vec3, height_m: float) -> None:
        self.gated = self.jumps = 0
        self._before = (0, 0)  # gated and jumps of earlier filters
        self._params, self._height_m = {"start": start, **fusion}, height_m
        self._fusion = self._filter({})
        self._last: Sample | None = None
        self._broken = False  # the newest sample is not finite
        self._turned = 0.0  # from odometry's yaw to the heading

    def _filter(self, changed: dict[str, Any]) -> "Fusion":
        from vcmvsp.cosim.estimation.fusion import Fusion  # SciPy takes half a second to load

        return binding.call(Fusion, {**self._params, **changed}, key="fusion")

    def sample(self, sample: Sample, now_ns: int) -> None:
        """Add the motion since the last sample, unless the link was lost in between."""
        self._broken = not all(map(math.isfinite, sample.odometry.pose))
        if self._broken:
            return
        last, self._last = self._last, sample
        if last is not None and sample.link != last.link:
            self._begin_again(now_ns)
            last = None
        odometry_time_ns = min(sample.measured_ns, now_ns)
        self._fusion.odometry(
            odometry_time_ns, *((0.0, 0.0) if last is None else travelled(last.odometry.pose, sample.odometry.pose))
        )

    def _begin_again(self, now_ns: int) -> None:
        """Restart the filter from the present estimate and its uncertainty."""
        self._before = (self.gated, self.jumps)
        estimate = self._fusion.estimate(now_ns)
        if estimate is None or not estimate.heading_known:
            self._fusion = self._filter({"start": None})
            return
        var_x, var_y, var_heading = estimate.covariance.diagonal().tolist()
        sigmas = {"start_sigma_m": math.sqrt(max(var_x, var_y)), "start_sigma_rad": math.sqrt(var_heading)}
        self._fusion = self._filter({"start": (estimate.x, estimate.y, estimate.heading), **sigmas})

    def fix(self, fix: Fix) -> None:
        """Take a fix; one that is not finite is ignored."""
        x, y, _ = fix.position
        if math.isfinite(x) and math.isfinite(y) and 0.0 < fix.sigma_m < math.inf:
            self._fusion.fix(fix.time_ns, x, y, fix.sigma_m)

    def at(self, now_ns: int) -> StateEstimate | None:
        """Fused state; None before the first sample."""
        pose = self._fusion.estimate(now_ns)
        if pose is None or self._last is None or self._broken:
            return None
        self.gated, self.jumps = self._before[0] + pose.gated, self._before[1] + pose.restarts
        odometry_ns = min(self._last.measured_ns, now_ns)
        last = self._last.odometry
        yaw = last.pose[2] + last.w * min(now_ns - odometry_ns, LONGEST_NS) / SECOND_NS
        if pose.heading_known:
            self._turned = pose.heading - yaw
        heading = wrap(yaw + self._turned)
        has_fix = math.isfinite(pose.age_s)
        measured_ns = fix_age_s = None  # without a fix the state is a guess
        if has_fix:
            fix_age_s = pose.age_s
            measured_ns = min(now_ns - round(pose.age_s * SECOND_NS), odometry_ns)
        return StateEstimate(
            state=planar((pose.x, pose.y, heading), pose.v, pose.w, self._height_m),
            covariance=pose.covariance,
            measured_ns=measured_ns,
            fix_age_s=fix_age_s,
        )


StateEstimator = DriverEstimator | FusedEstimator
