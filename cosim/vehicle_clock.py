"""Clocks of vehicles: what they show at a time of the run, and received messages and readings with these times.

The kernel, the channel and the recording know the time of the run only. A host translates the times that its agents get.
"""

import math
from collections.abc import Callable, Mapping
from functools import partial
from typing import Annotated, Any

import msgspec
import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.rng import key64, link_uniform
from vcmvsp.cosim.types import Later, NonNegative, Reading, Receptions, Seconds, Value, frozen

_PARTS = 10**9  # drifts are counted in parts of 10^9

Offset = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]  # s
Drift = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]  # parts per million


class ClockStep(Value, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A jump of a clock, e.g. when it is set."""

    at_s: Seconds  # time of the run
    by_s: Offset  # positive: the clock is set forward


class VehicleClock(Value, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A vehicle's clock: at the run's time t it shows ``t + offset + drift t``, after a step also that, and jitter."""

    offset_s: Offset = 0.0  # at the start of the run
    drift_ppm: Drift = 0.0  # rate error; positive: it runs fast. A quartz has up to 100
    jitter_s: NonNegative = 0.0  # standard deviation of single readings (normal)
    step: ClockStep | None = None  # a jump; default: none

    def mean_ns(self, time_ns: int) -> int:
        """What it shows at a time of the run, without jitter."""
        shown_ns = time_ns + seconds_to_ns(self.offset_s) + time_ns * round(self.drift_ppm * 1000.0) // _PARTS
        if self.step is not None and time_ns >= seconds_to_ns(self.step.at_s):
            shown_ns += seconds_to_ns(self.step.by_s)
        return shown_ns

    def time_ns(self, shown_ns: int) -> int:
        """The first time of the run at which it shows a time or a later one, without jitter; may be negative."""
        time_ns = self._before_step_ns(shown_ns)
        if self.step is not None and time_ns >= (step_ns := seconds_to_ns(self.step.at_s)):
            time_ns = max(step_ns, self._before_step_ns(shown_ns - seconds_to_ns(self.step.by_s)))
        return time_ns

    def _before_step_ns(self, shown_ns: int) -> int:
        passed_ns = shown_ns - seconds_to_ns(self.offset_s)
        return -(-passed_ns * _PARTS // (_PARTS + round(self.drift_ppm * 1000.0)))  # rounded up


class VehicleClocks:
    """The clocks of a run by vehicle; a vehicle without one has the time of the run.

    The jitter of a reading is a function of seed, vehicle and time: it does not depend on how often a clock is read, and all
    that a vehicle stamps at one instant has the same time.
    """

    def __init__(self, seed: int, clocks: Mapping[str, VehicleClock]) -> None:
        self._clocks = {name: (clock, key64(seed, f"{name}/clock")) for name, clock in clocks.items()}

    def __contains__(self, vehicle: str) -> bool:
        return vehicle in self._clocks

    def reading_ns(self, vehicle: str, time_ns: int) -> int:
        """What a vehicle's clock shows at a time of the run, ns."""
        entry = self._clocks.get(vehicle)
        if entry is None:
            return time_ns
        clock, key = entry
        shown_ns = clock.mean_ns(time_ns)
        if clock.jitter_s:
            keys, times = (np.array([each % 2**64], np.uint64) for each in (key, time_ns))
            ((first, second),) = link_uniform(keys, times, 0).tolist()
            normal = math.sqrt(-2.0 * math.log1p(-first)) * math.cos(math.tau * second)  # G. E. P. Box, M. E. Muller, 1958
            shown_ns += round(clock.jitter_s * normal * SECOND_NS)
        return shown_ns

    def stamped(self, batch: Receptions) -> Receptions:
        """Receptions with the sender's time of each sending, and the receiver's time of each arrival."""
        if not self._clocks:
            return batch
        senders = (message.sender for message in batch.messages)
        receivers = (batch.names[row] for row in batch.receiver.tolist())
        sent_ns = [self.reading_ns(*each) for each in zip(senders, batch.sent_ns.tolist(), strict=True)]
        arrival_ns = [self.reading_ns(*each) for each in zip(receivers, batch.arrival_ns.tolist(), strict=True)]
        columns = {"sent_ns": frozen(sent_ns, np.int64), "arrival_ns": frozen(arrival_ns, np.int64)}
        return msgspec.structs.replace(batch, **columns)

    def measured(self, vehicle: str, reading: Reading | Later) -> Any:
        """A reading with the vehicle's time of the measurement; readings on demand stay so."""
        return timed(reading, partial(self.reading_ns, vehicle))


def timed(reading: Reading | Later, clock: Callable[[int], int]) -> Any:
    """A reading with another time of its measurement: ``clock`` of the present one."""
    if isinstance(reading, Later):
        return Later(lambda: timed(reading.get(), clock))
    time_ns = getattr(reading, "time_ns", None)
    return reading if time_ns is None else msgspec.structs.replace(reading, time_ns=clock(time_ns))
