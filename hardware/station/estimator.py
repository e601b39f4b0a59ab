"""State of a robot at any instant, from the newest samples of its driver and its localisation.

Between samples the state is extrapolated for a limited time, then the robot stands (`cosim.estimation.dead_reckoning`).
"""

from typing import Protocol

import msgspec

from vcmvsp.cosim.estimation.dead_reckoning import ahead, planar
from vcmvsp.cosim.types import Array, Fix, VehicleState
from vcmvsp.hardware.drivers.base import Sample


class StateEstimate(msgspec.Struct, frozen=True, kw_only=True):
    """State at an instant."""

    state: VehicleState
    covariance: Array | None = None  # (3, 3) of x, y, yaw
    measured_ns: int | None = None  # time of the measurement; None: none yet
    fix_age_s: float | None = None


class StateEstimator(Protocol):
    """Takes samples and fixes in order of arrival; their times must not lie in the future.

    Attributes:
        gated: number of rejected fixes.
        jumps: number of restarts from rejected fixes.
    """

    gated: int
    jumps: int

    def sample(self, sample: Sample, now_ns: int) -> None:
        """Take a sample of the driver."""

    def fix(self, fix: Fix) -> None:
        """Take a fix of the localisation."""

    def at(self, now_ns: int) -> StateEstimate | None:
        """The state now; None: unknown."""


class DriverEstimator:
    """State as the driver reports it; odometry if it reports none, but not for a vehicle that flies."""

    def __init__(self, height_m: float, *, flies: bool) -> None:
        self.gated = self.jumps = 0
        self._height_m, self._flies = height_m, flies
        self._last: Sample | None = None

    def sample(self, sample: Sample, now_ns: int) -> None:
        """The newest counts."""
        self._last = sample

    def fix(self, fix: Fix) -> None:
        """Ignored."""

    def at(self, now_ns: int) -> StateEstimate | None:
        """Extrapolated to now."""
        last = self._last
        if last is None or (last.state is None and self._flies):
            return None
        measured_ns = min(last.measured_ns, now_ns)
        state = last.state or planar(last.odometry.pose, last.odometry.v, last.odometry.w, self._height_m)
        return StateEstimate(state=ahead(state, now_ns - measured_ns, flies=self._flies), measured_ns=measured_ns)
