"""The robot's own driver under the control of a run: opened and closed with it, stopped without commands.

All methods are called in the main thread, where calls that hang are aborted.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from typing import Literal

import msgspec

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import words_of
from vcmvsp.cosim.types import Vec3
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import Driver, DriverError, Notice, Sample, nothing, within
from vcmvsp.hardware.drivers.threaded import NOT_YET
from vcmvsp.hardware.remote_robot.messages import DEADMAN_S, FAILURES, NOTICES_AT_ONCE, Failure, RobotOrder

GRACE_S = 2.0  # beyond the driver's own deadlines
KEPT = 1000  # notices without acknowledgement
_DEADMAN_NS = seconds_to_ns(DEADMAN_S)


class DriverWatchdog:
    """Drives the robot; without a given pose, the run defines the pose at its start."""

    def __init__(self, driver: Driver, pose: Vec3 | None, tell: Callable[[str], None]) -> None:
        self._driver, self._pose, self._tell = driver, pose, tell
        self.run = ""  # name of the last run
        self.state: Literal["closed", "opening", "open"] = "closed"
        self.opened = self.noticed = 0  # openings, and notices that the run acknowledged
        self.failure: Failure | None = None  # why it cannot continue; None: it can
        self._notices: deque[Notice] = deque(maxlen=KEPT)
        self._stood = False  # the run has commanded to stand since its link began
        self._stopped = NOT_YET  # reason to stand; empty: it drives
        self._velocity_ns = 0
        self._late = False

    def open(self, run: str, start: Vec3, abort_reason: Callable[[], str]) -> None:
        """Open the driver for a run at x m, y m, yaw rad, unless ``abort_reason`` returns a text; raises `DriverError`."""
        self.run, self.failure, self.state = run, None, "opening"
        self.noticed += len(self._notices)  # of an earlier run
        self._notices.clear()
        self._stood, self._stopped, self._late = False, NOT_YET, False
        self.opened += 1
        driver = self._driver
        x, y, yaw = start if self._pose is None else self._pose
        self._tell(f"opening {driver.device} at x {x:.2f} m, y {y:.2f} m, yaw {yaw:.2f} rad")
        with within(driver.open_deadline_s + GRACE_S, driver.device, "opening it", abort_reason):
            driver.open((x, y, yaw))
        self.state = "open"
        self._gather()

    def meet(self) -> None:
        """The link to the run is new: stand until the run has commanded to stand."""
        self._stood = False
        self.stop("its run has just connected")

    def follow(self, order: RobotOrder, now_ns: int) -> None:
        """Obey an order; a velocity that may be too old, by this clock, is ignored."""
        while self._notices and self.noticed < order.noticed:
            self._notices.popleft()
            self.noticed += 1
        if self.state != "open":
            return
        if order.velocity is None:
            self._stood = True
            self.stop(plain(order.stop) or NOT_YET)
        elif not all(map(math.isfinite, (*order.velocity.linear, order.velocity.yaw_rate))):
            self.stop("a velocity of the run is not a number")
        elif self._stood and self._is_fresh(order, now_ns):
            self._stopped, self._velocity_ns = "", now_ns
            self._driver.write(order.velocity)

    def stop(self, cause: str) -> None:
        """Stop the robot; reported once for each cause."""
        if self.state == "open" and self._stopped != cause:
            self._stopped = cause
            self._driver.stop(cause)

    def turn(self, now_ns: int) -> Sample | None:
        """Run one cycle; the newest sample, if there is one."""
        if self.state != "open":
            return None
        if not self._stopped and now_ns >= self._velocity_ns + _DEADMAN_NS:
            self.stop(f"no velocity from the run for {DEADMAN_S:g} s")
        sample = self._driver.read()
        self._gather()
        return sample

    def fail(self, error: Exception, meanwhile: Callable[[], str] = nothing) -> None:
        """Record a failure, and close the driver."""
        self.failure = _failure(self._driver.device, error)
        self._tell(f"{self.failure.device}: {self.failure.happened}; {self.failure.advice}")
        self.close(self.failure.happened, meanwhile)

    def end(self, why: str, meanwhile: Callable[[], str]) -> None:
        """Close the driver permanently, and report why."""
        if self.state != "closed":
            self.failure = Failure(kind="lost", device=self._driver.device, happened=why, advice="start it again")
            self.close(why, meanwhile)

    def close(self, cause: str, meanwhile: Callable[[], str] = nothing) -> None:
        """Stop the robot and close its driver, in any state; ``meanwhile`` is called repeatedly, and aborts with a text."""
        if self.state == "closed":
            return
        self.state = "closed"
        driver = self._driver

        def stop() -> None:
            if self._stopped != cause:
                driver.stop(cause)

        seconds = (GRACE_S, "stopping it", stop), (driver.close_deadline_s + GRACE_S, "closing it", driver.close)
        for most_s, doing, action in seconds:
            try:
                with within(most_s, driver.device, doing, meanwhile):
                    action()
            except Exception as error:
                self._tell(f"{doing}: {error}")
        self._gather()
        self._tell(f"closed {driver.device}")

    def notices(self) -> tuple[Notice, ...]:
        """Notices without acknowledgement, oldest first."""
        return tuple(self._notices)[:NOTICES_AT_ONCE]

    def _gather(self) -> None:
        try:
            new = self._driver.notices()
        except Exception as error:
            self._tell(f"the failure of its driver cannot be read: {error}")
            return
        new = [msgspec.structs.replace(each, cause=plain(each.cause)) for each in new]
        for each in new:
            self._tell(f"{each.what}: {each.cause}")
        self.noticed += max(0, len(self._notices) + len(new) - KEPT)  # the oldest are dropped
        self._notices.extend(new)

    def _is_fresh(self, order: RobotOrder, now_ns: int) -> bool:
        """Whether the order answers a recent status of this program."""
        fresh = order.yours_ns > 0 and now_ns - order.yours_ns <= _DEADMAN_NS
        if not fresh and not self._late:
            self._late = True
            way = f"{(now_ns - order.yours_ns) / 1e9:.1f} s for both ways" if order.yours_ns else "the run received nothing"
            cause = f"velocities arrive too late and are ignored: {way}"
            self._tell(f"warned: {cause}")
            self._notices.append(Notice(time_ns=time.monotonic_ns(), what="warned", cause=cause))
        return fresh


def _failure(device: str, error: Exception) -> Failure:
    if not isinstance(error, DriverError):
        happened = plain(f"its driver failed ({words_of(error)})")
        return Failure(kind="driver", device=plain(device), happened=happened, advice="report this to the author of the driver")
    kind = next(word for word, each in FAILURES.items() if isinstance(error, each))
    device, happened, advice = map(plain, (error.device, error.happened, error.advice))
    return Failure(kind=kind, device=device, happened=happened, advice=advice)
