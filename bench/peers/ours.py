"""Ours: the kernel, a world that only publishes, and hosts of agents with almost no work. Nothing is recorded."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from bench.peers.pace import BEAMS, COMMAND, STATE, Options, Pace, busy, options
from vcmvsp.cosim.agent import Agent, Observation, Radio
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import NonNegative, Scan, VehicleState, Velocity, frozen
from vcmvsp.cosim.util.codec import encode

PERIOD_NS = 100_000_000
STATE_SEEN = VehicleState(**STATE)  # type: ignore[arg-type]
SCAN_SEEN = Scan(ranges=frozen(np.linspace(0.1, 9.9, BEAMS), np.float32), angle_min=-2.0, angle_step=0.01, range_max=10.0)
SAID = Velocity(**COMMAND)  # type: ignore[arg-type]


class World:
    """Publishes every vehicle's pose, and its scan if it has a scanner."""

    name = "physics"
    slot = wake_slot = Slot.WORLD
    reads = ("*/command",)
    latest: tuple[str, ...] = ()
    wakes: tuple[str, ...] = ()

    def __init__(self, world: Any, vehicles: Any, outside: Any = None, busy_s: NonNegative = 0.0) -> None:
        self._busy_s = busy_s
        self._publications = [(f"{each.name}/estimate", STATE_SEEN) for each in vehicles]
        self._publications += [(f"{each.name}/scan", SCAN_SEEN) for each in vehicles if each.sensors]  # type: ignore[misc]

    def start(self, run: RunInfo) -> int | None:
        """Publish at once."""
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        """Publish."""
        busy(self._busy_s)
        return Step([Event(key, now_ns, value) for key, value in self._publications], now_ns + PERIOD_NS)

    def close(self) -> None:
        """Nothing to close."""


class Still(Agent):
    """Answers with a constant command."""

    def __init__(self, busy_s: NonNegative = 0.0) -> None:
        self._busy_s = busy_s

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """A command of nearly a hundred bytes."""
        busy(self._busy_s)
        return SAID


def scenario(settings: Options) -> dict[str, Any]:
    """The star."""
    equipment: dict[str, Any] = {"agent": {}}
    if settings.scans:
        scanner = {"kind": "range_scanner", "beams": BEAMS, "field_of_view": 4.0, "range_max": 10.0}
        equipment["sensors"] = {"scan": scanner}
    return {
        "name": "bench",
        "duration_s": 1e6,
        "physics": {"kind": "bench.peers.ours:World", "busy_s": settings.world_s},
        "radio": {"preset": "ideal"},
        "vehicles": {"kind": "point"},
        "agents": {
            "kind": "bench.peers.ours:Still",
            "runs": "process" if settings.processes else "inprocess",
            "period_s": PERIOD_NS / 1e9,
            "latency_s": settings.latency_s,
            "busy_s": settings.busy_s,
            "deadline_s": 30.0,
            "processes": settings.processes or 1,
        },
        "vehicle": [{"name": f"car{n:02}", **equipment} for n in range(settings.agents)],
    }


def sizes(scans: bool) -> tuple[int, int]:
    """Bytes of an agent's observation and answer on the wire."""
    late_ns = 1000 * PERIOD_NS
    observation = [Event("car00/estimate", late_ns, STATE_SEEN), *([Event("car00/scan", late_ns, SCAN_SEEN)] if scans else [])]
    return sum(len(encode(each)) for each in observation), len(encode(Event("car00/command", late_ns, SAID)))


def main() -> None:
    """Run until the parent ends the program."""
    settings = options()
    pace = Pace(settings)
    parsed, source = scenarios.load(scenario(settings))
    with assemble(parsed, source) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        kernel.start()

        def instant(_: int) -> None:
            kernel.stop = not pace.step()

        try:
            kernel.run(lambda _: None, on_instant=instant)
        except KeyboardInterrupt:  # the parent's stop
            kernel.close()


if __name__ == "__main__":
    main()
