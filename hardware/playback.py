"""Playback of recorded real vehicles in place of robots and their stations, not paced by the wall clock."""

from bisect import bisect_right
from collections.abc import Callable, Sequence
from math import fsum, sqrt

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.federate import Event, RunInfo, Step
from vcmvsp.cosim.frames import Quaternion
from vcmvsp.cosim.recording.external_inputs import REFLECTED, EventPlayback, Input
from vcmvsp.cosim.types import ORIGIN, Odometry, Outage, Vec3, VehicleState


class Playback(EventPlayback):
    """The federate ``hardware`` (`cosim.federate.ExternalVehicles`) from ``hardware.mcap``. Commands have no effect.

    Each event is published again at its time. Physics gets the recorded state of each instant; between two instants, if a
    period was changed, a linear interpolation (at 0.5 m/s, 0.5 rad/s and 10 Hz its error is v w dt^2 / 8 = 0.3 mm at most).
    Vehicles that are not in ``names`` are ignored; `UsageError`: the recording has no state of one that is.

    If the recording ends before the run, vehicles stand at their last place; their last estimates and odometry are published
    once more, at rest, and one message says so.
    """

    def __init__(
        self, names: tuple[str, ...], inputs: Sequence[Input], *, tell: Callable[[str], None] = lambda _: None
    ) -> None:
        super().__init__("hardware", [])
        self.names, self._tell = names, tell
        self._tracks = {name: _Trajectory() for name in names}
        self._recorded: list[Event] = []
        self._end_ns = 0
        for key, time_ns, value in inputs:
            vehicle, _, topic = key.partition("/")
            if vehicle not in self._tracks:
                continue
            self._end_ns = max(self._end_ns, time_ns)
            if topic == REFLECTED and isinstance(value, VehicleState):
                self._tracks[vehicle].times_ns.append(time_ns)
                self._tracks[vehicle].states.append(value)
            else:
                self._recorded.append(Event("operator/outage" if isinstance(value, Outage) else key, time_ns, value))
        if missing := [name for name, track in self._tracks.items() if not track.times_ns]:
            recorded = ", ".join(sorted({key.partition("/")[0] for key, _, _ in inputs})) or "nobody"
            raise UsageError(f"the recording has no positions of {', '.join(missing)}; it has {recorded}")

    def start(self, run: RunInfo) -> int | None:
        """Time of the first event."""
        self.events = [*self._recorded]
        if self._end_ns < run.duration_ns:
            self.events += [Event(key, self._end_ns + 1, value) for key, value in self._at_rest().items()]
        return super().start(run)

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Events of this instant."""
        if now_ns > self._end_ns:
            names, verb = ", ".join(self.names), "stands" if len(self.names) == 1 else "stand"
            self._tell(f"the recording ends at {self._end_ns / SECOND_NS:.3f} s: {names} {verb} still from then on")
        return super().step(now_ns, inbox)

    def states(self, now_ns: int) -> list[VehicleState]:
        """Recorded states, in the order of ``names``."""
        return [track.at(now_ns) for track in self._tracks.values()]

    def _at_rest(self) -> dict[str, VehicleState | Odometry]:
        last: dict[str, VehicleState | Odometry] = {}
        for event in self._recorded:
            if isinstance(event.value, VehicleState):
                last[event.key] = at_rest(event.value)
            elif isinstance(event.value, Odometry):
                last[event.key] = msgspec.structs.replace(event.value, v=0.0, w=0.0)
        return last


class _Trajectory:
    def __init__(self) -> None:
        self.times_ns: list[int] = []
        self.states: list[VehicleState] = []

    def at(self, now_ns: int) -> VehicleState:
        """State at a time: the first state before the recording, the last one at rest after it."""
        following = bisect_right(self.times_ns, now_ns)
        if following == 0:
            return self.states[0]
        before_ns, before = self.times_ns[following - 1], self.states[following - 1]
        if before_ns == now_ns:
            return before
        if following == len(self.times_ns):
            return at_rest(before)
        share = (now_ns - before_ns) / (self.times_ns[following] - before_ns)
        return between(before, self.states[following], share)


def at_rest(state: VehicleState) -> VehicleState:
    """The state with zero velocity."""
    return msgspec.structs.replace(state, velocity=ORIGIN, angular_velocity=ORIGIN)


def between(before: VehicleState, after: VehicleState, share: float) -> VehicleState:
    """Interpolation between two states by ``share`` from 0 to 1; attitudes along the shorter arc."""
    return VehicleState(
        position=_mixed(before.position, after.position, share),
        velocity=_mixed(before.velocity, after.velocity, share),
        attitude=_turned(before.attitude, after.attitude, share),
        angular_velocity=_mixed(before.angular_velocity, after.angular_velocity, share),
    )


def _mixed(a: Vec3, b: Vec3, share: float) -> Vec3:
    x, y, z = (start + share * (end - start) for start, end in zip(a, b, strict=True))
    return x, y, z


def _turned(a: Quaternion, b: Quaternion, share: float) -> Quaternion:
    """Normalised linear interpolation; its angle is off by less than 1e-4 of a turn by 0.3 rad."""
    dot = fsum(p * q for p, q in zip(a, b, strict=True))
    sign = 1.0 if dot >= 0.0 else -1.0  # q and -q are the same attitude
    mixed = [p + share * (sign * q - p) for p, q in zip(a, b, strict=True)]
    norm = sqrt(fsum(each * each for each in mixed))
    w, x, y, z = (each / norm for each in mixed)
    return w, x, y, z
