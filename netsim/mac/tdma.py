"""Time division: each radio sends in its own slots, by the clock of its vehicle.

Slot i of a schedule of m slots begins, by a vehicle's clock, at ``(k m + i) slot_s``, k = 0, 1, ... A radio sends one frame in
a slot, ``guard_s`` after its begin; the frame must end ``guard_s`` before its end. So clocks that differ by up to ``2 guard_s``
never make frames of neighbouring slots overlap. Jitter of a clock has no effect. Collisions: `netsim.mac.blind`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec

from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import NonNegative, Period
from vcmvsp.cosim.vehicle_clock import VehicleClock
from vcmvsp.netsim.interfaces.layers import Keys, Phy
from vcmvsp.netsim.interfaces.medium import Medium, Offered
from vcmvsp.netsim.mac.blind import BlindEvent, BlindMedium, BlindRadio

STEPPED_NS = 1000  # a clock that differs by more from what was expected was set meanwhile

Many = Annotated[int, msgspec.Meta(ge=1)]


class TdmaRadio(BlindRadio):
    """The queue of one radio, its slots, and its clock."""

    def __init__(self, row: int, slots: Sequence[int], clock: VehicleClock) -> None:
        super().__init__(row)
        self.slots, self.clock = slots, clock


class TdmaMedium(BlindMedium[TdmaRadio]):
    """The `netsim.interfaces.medium.Medium` of time division; ``slots``: number of slots after which the schedule repeats.

    The number of a turn is its begin by the radio's clock, ns.
    """

    def __init__(self, rules: "Tdma", phy: Phy, radios: Sequence[TdmaRadio], slots: int, noise_mw: float) -> None:
        super().__init__(rules.queue_frames, phy, radios, noise_mw)
        self._slot_ns, self._guard_ns = seconds_to_ns(rules.slot_s), seconds_to_ns(rules.guard_s)
        self._period_ns = slots * self._slot_ns

    def offer(self, frame: Offered) -> None:
        """Hand over a frame; raises `ScenarioError` if it fits in no slot."""
        air_ns, room_ns = self._phy.air_time_ns(frame.size_bytes), self._slot_ns - 2 * self._guard_ns
        if air_ns > room_ns:
            problem = f"a frame of {frame.size_bytes} bytes takes {air_ns / 1e6:g} ms, and a slot has {room_ns / 1e6:g} ms"
            raise ScenarioError(f"{problem}: use longer slots, or shorter messages", key="radio.mac.slot_s")
        super().offer(frame)

    def _await_turn(self, now_ns: int, radio: TdmaRadio) -> None:
        """Schedule the next slot of a radio; without slots its frames wait until the run ends."""
        radio.is_busy = bool(radio.slots)
        if not radio.slots:
            return
        own_ns = radio.clock.mean_ns(now_ns)
        offsets_ns = [slot * self._slot_ns + self._guard_ns for slot in radio.slots]
        begin_ns = min(offset - (offset - own_ns) // self._period_ns * self._period_ns for offset in offsets_ns)
        self._schedule(max(now_ns, radio.clock.time_ns(begin_ns)), BlindEvent.TURN, radio, begin_ns)

    def _take_turn(self, now_ns: int, radio: TdmaRadio, turn: int) -> None:
        if abs(radio.clock.mean_ns(now_ns) - turn) > STEPPED_NS:
            self._await_turn(now_ns, radio)
        else:
            super()._take_turn(now_ns, radio, turn)


@dataclass(frozen=True)
class Tdma:
    """Time division: each radio sends in its own slots, by the clock of its vehicle (`clock`).

    Args:
        slot_s: length of a slot: the time on the air of the longest frame, and twice the guard time, at least.
        schedule: vehicle of each slot in turn, "": none; default: a slot for each vehicle in the scenario's order. A vehicle
            without a slot never sends.
        guard_s: time without sending at the begin and at the end of a slot.
        queue_frames: maximum number of frames at a sender, with the frame on the air; None: no limit.
    """

    slot_s: Period
    schedule: tuple[str, ...] = ()
    guard_s: NonNegative = 0.0
    queue_frames: Many | None = None

    def __post_init__(self) -> None:
        if 2.0 * self.guard_s >= self.slot_s:
            raise ScenarioError(f"must be less than half of slot_s = {self.slot_s:g}, not {self.guard_s:g}", key="guard_s")

    def names(self) -> tuple[str, ...]:
        """Names in the schedule."""
        return tuple(name for name in self.schedule if name)

    def open(self, phy: Phy, count: int, keys: Keys, noise_mw: float) -> Medium:
        """The medium of ``count`` radios with a slot each, without names and clocks."""
        return replace(self, schedule=()).open_named(phy, [str(row) for row in range(count)], {}, noise_mw)

    def open_named(self, phy: Phy, names: Sequence[str], clocks: Mapping[str, VehicleClock], noise_mw: float) -> Medium:
        """The medium of vehicles with the clocks of some of them."""
        schedule = self.schedule or tuple(names)
        radios = []
        for row, name in enumerate(names):
            slots = tuple(slot for slot, owner in enumerate(schedule) if owner == name)
            radios.append(TdmaRadio(row, slots, clocks.get(name, VehicleClock())))
        return TdmaMedium(self, phy, radios, len(schedule), noise_mw)
