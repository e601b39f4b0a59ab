"""The federate `energy`: batteries of vehicles, which motion, electronics and radio empty.

======================  =========  ===========================================================================
key                     direction  value
======================  =========  ===========================================================================
``world/states``        in         `States`: true velocities
``radio/frame``         in         `FrameReport`: time on the air of sent and received frames
``radio/traffic``       in         `Traffic`: the same for datagrams of programs
``<vehicle>/battery``   out        `Measured`: ``charge`` (share of the capacity), ``power_w``, ``used_j``,
                                   ``motion_j`` and ``radio_j`` (parts of it)
======================  =========  ===========================================================================

Power is integrated over the instants at which states are published, by the trapezoidal rule. A battery is read every
``period_s``, when it is empty, and at the end of the run.

In the air, with the thrust T, the area A of all rotors and the density rho of the air, the momentum theory gives the induced
speed v of a rotor that moves with V across and Vc along its axis (H. Glauert 1926; J. G. Leishman, Principles of Helicopter
Aerodynamics, 2nd ed., equation 2.126)::

    v sqrt(V^2 + (Vc + v)^2) = T / (2 rho A)        P = (T (Vc + v) + D V) / (rotor_efficiency drive_efficiency)

Without motion this is ``P = T^(3/2) / sqrt(2 rho A)``. T carries weight and drag D; a descent counts as level flight, as
momentum theory does not hold in it. On wheels ``P = rolling_resistance m g |v| / drive_efficiency``: work of acceleration does
not count. Of the radio, each frame counts once: no repetitions of unicast frames, no acknowledgements.
"""

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS, Ticks
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.scenario.schema import BatteryTable
from vcmvsp.cosim.types import FrameReport, Measured, States, Traffic, Vec3
from vcmvsp.physics.dynamics.wind import AIR_KG_M3

ROTORS = 4
NEWTON = 50  # iterations at most; a few are needed

Power = Callable[[Vec3], float]
"""Power for the motion at a velocity (m/s, world), W."""


def induced_speed(hover: float, across: float, along: float) -> float:
    """Induced speed of a rotor, m/s.

    Args:
        hover: without motion, ``sqrt(T / (2 rho A))``, m/s.
        across: speed across its axis, m/s.
        along: speed along its axis, upwards, >= 0, m/s.
    """
    speed = hover
    for _ in range(NEWTON):  # of v sqrt(V^2 + (Vc + v)^2) - hover^2, which is convex and increasing in v
        flow = math.hypot(across, along + speed)
        excess = speed * flow - hover**2
        step = excess / (flow + speed * (along + speed) / flow)
        speed -= step
        if abs(step) < 1e-12 * hover:
            break
    return speed


def flight_power(battery: BatteryTable, mass_kg: float, rotor_radius_m: float, drag: Vec3, gravity: float) -> Power:
    """Power of a multirotor; ``drag``: along x, y and z, N s/m."""
    area_m2 = ROTORS * math.pi * rotor_radius_m**2
    efficiency = battery.rotor_efficiency * battery.drive_efficiency

    def power_w(velocity: Vec3) -> float:
        across, along = math.hypot(velocity[0], velocity[1]), max(velocity[2], 0.0)
        across_n, along_n = drag[0] * across, drag[2] * along
        thrust_n = math.hypot(mass_kg * gravity + along_n, across_n)
        hover = math.sqrt(thrust_n / (2.0 * AIR_KG_M3 * area_m2))
        induced = induced_speed(hover, across, along)
        return (thrust_n * (along + induced) + across_n * across) / efficiency

    return power_w


def rolling_power(battery: BatteryTable, mass_kg: float, gravity: float) -> Power:
    """Power of a vehicle on wheels."""
    force_n = battery.rolling_resistance * mass_kg * gravity / battery.drive_efficiency
    return lambda velocity: force_n * math.hypot(velocity[0], velocity[1])


class BatteryState:
    """Charge of one battery."""

    def __init__(self, battery: BatteryTable, power: Power) -> None:
        self.battery, self._power = battery, power
        self._ticks = Ticks.every(battery.period_s)
        self._capacity_j = 3600.0 * battery.capacity_wh
        self._start_j = self._capacity_j * battery.charge
        self.power_w = self.motion_j = self.radio_j = self.others_j = 0.0
        self._motion_w: float | None = None  # at the last instant
        self.due_ns = 0  # of the next reading

    @property
    def used_j(self) -> float:
        """Energy that was taken from it, J."""
        return min(self.motion_j + self.radio_j + self.others_j, self._start_j)

    @property
    def is_empty(self) -> bool:
        """Whether all of its charge is used."""
        return self.used_j >= self._start_j

    def move(self, velocity: Vec3, elapsed_s: float) -> None:
        """Take the energy of the time since the last instant."""
        motion_w = self._power(velocity)
        before_w = motion_w if self._motion_w is None else self._motion_w
        self._motion_w = motion_w
        self.power_w = motion_w + self.battery.electronics_w
        self.motion_j += 0.5 * (before_w + motion_w) * elapsed_s
        self.others_j += self.battery.electronics_w * elapsed_s

    def read(self, now_ns: int) -> Measured:
        """The reading of this instant."""
        self.due_ns = self._ticks.after(now_ns)
        values = {
            "charge": max(0.0, self._start_j - self.used_j) / self._capacity_j,
            "power_w": 0.0 if self.is_empty else self.power_w,
            "used_j": self.used_j,
            "motion_j": self.motion_j,
            "radio_j": self.radio_j,
        }
        return Measured(time_ns=now_ns, values=values)


class Energy:
    """The batteries of a run; ``batteries``: table and motor power by vehicle."""

    name = "energy"
    slot = wake_slot = Slot.RADIO  # after physics, and before agents; the last instant of a run has no later slot
    reads: tuple[str, ...] = ("world/states", "radio/frame", "radio/traffic")
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ("world/states",)

    def __init__(self, batteries: Mapping[str, tuple[BatteryTable, Power]]) -> None:
        self._tables = batteries

    def start(self, run: RunInfo) -> int | None:
        """Charge all batteries."""
        self._batteries = {name: BatteryState(*each) for name, each in self._tables.items()}
        self._row = {name: row for row, name in enumerate(run.vehicles)}
        self._end_ns, self._now_ns = run.duration_ns, 0
        self._emptied: set[str] = set()  # of which the empty battery was read
        return None

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Take the energy of the motion since the last instant, and of the frames decided since then."""
        events: list[Event] = []
        for event in inbox:
            value = event.value
            if isinstance(value, FrameReport):
                self._count(value)
            elif isinstance(value, Traffic):
                for report in value.reports:
                    self._count(report)
            elif isinstance(value, States):
                events += self._move(value, event.time_ns)
        return Step(events)

    def close(self) -> None:
        """Nothing to release."""

    def _move(self, states: States, now_ns: int) -> list[Event]:
        elapsed_s, self._now_ns = (now_ns - self._now_ns) / SECOND_NS, now_ns
        readings = []
        for name, battery in self._batteries.items():
            if name in self._emptied:
                continue
            x, y, z = states.velocity[self._row[name]].tolist()
            battery.move((x, y, z), elapsed_s)
            if battery.is_empty:
                self._emptied.add(name)
            if battery.is_empty or now_ns == self._end_ns or now_ns >= battery.due_ns:
                readings.append(Event(f"{name}/battery", now_ns, battery.read(now_ns)))
        return readings

    def _count(self, report: FrameReport) -> None:
        air_s = report.air_time_ns / SECOND_NS
        if not air_s:
            return
        if (sender := self._batteries.get(report.sender)) is not None:
            sender.radio_j += sender.battery.tx_w * air_s
        for place in np.flatnonzero(report.received_ns >= 0).tolist():
            if (receiver := self._batteries.get(report.receivers[place])) is not None:
                receiver.radio_j += receiver.battery.rx_w * air_s
