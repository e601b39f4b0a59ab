"""mosaik (mosaik.offis.de): a world in mosaik's own process, and simulators that hold the agents, there or elsewhere.

Agents see the present, the world the answers of the previous step (a time-shifted connection), as in ours; a loop within a
step (`weak` connections) takes longer. mosaik carries JSON, so states and scans are lists of numbers.
"""

import contextlib
import sys
from typing import Any

import mosaik  # type: ignore[import-not-found]
import mosaik_api_v3  # type: ignore[import-not-found]

from bench.peers.pace import BEAMS, COMMAND, STATE, Options, Pace, busy, options

STILL = "bench.peers.mosaik_star"
END = 10**9


class EnoughError(Exception):
    """Ends a run early."""


class World(mosaik_api_v3.Simulator):  # type: ignore[misc]
    """Publishes the observations of all vehicles."""

    def __init__(self) -> None:
        attributes = {"public": True, "params": [], "attrs": ["seen", "command"]}
        super().__init__({"type": "time-based", "models": {"Vehicle": attributes}})

    def init(self, sid: str, time_resolution: float, *, pace: Pace, scans: bool) -> Any:
        """Time 0."""
        self._pace = pace
        self._observation: dict[str, Any] = dict(STATE)
        if scans:
            self._observation["scan"] = [0.1 + n / 51.0 for n in range(BEAMS)]
        return self.meta

    def create(self, num: int, model: str) -> Any:
        """All vehicles."""
        self._count = num
        return [{"eid": f"v{n}", "type": model} for n in range(num)]

    def step(self, time: int, inputs: Any, max_advance: int) -> int:
        """The next step is one later."""
        assert time < 2 or len(inputs) == self._count
        if not self._pace.step():
            raise EnoughError
        return time + 1

    def get_data(self, outputs: Any) -> Any:
        """Equal values for all."""
        return {each: {"seen": self._observation} for each in outputs}


class Still(mosaik_api_v3.Simulator):  # type: ignore[misc]
    """Agents with a constant answer."""

    def __init__(self) -> None:
        attributes = {"public": True, "params": [], "attrs": ["seen", "command"]}
        super().__init__({"type": "time-based", "models": {"Agent": attributes}})

    def init(self, sid: str, time_resolution: float, *, busy_s: float = 0.0) -> Any:
        """Time 0."""
        self._busy_s = busy_s
        return self.meta

    def create(self, num: int, model: str) -> Any:
        """All agents."""
        return [{"eid": f"a{n}", "type": model} for n in range(num)]

    def step(self, time: int, inputs: Any, max_advance: int) -> int:
        """Read the inputs."""
        for attributes in inputs.values():
            (observation,) = attributes["seen"].values()
            assert observation["position"]
            busy(self._busy_s)
        return time + 1

    def get_data(self, outputs: Any) -> Any:
        """Equal values for all."""
        return {each: {"command": COMMAND} for each in outputs}


def main(settings: Options) -> None:
    """Run until the parent ends the program."""
    pace, groups = Pace(settings), max(1, settings.processes)
    elsewhere = {"cmd": f"{sys.executable} -m {STILL} %(addr)s"}
    config = {
        "World": {"python": f"{__name__}:World"},
        "Still": elsewhere if settings.processes else {"python": f"{__name__}:Still"},
    }
    star = mosaik.World(config, skip_greetings=True, configure_logging=False)
    vehicles = star.start("World", pace=pace, scans=settings.scans).Vehicle.create(settings.agents)
    hosts = [star.start("Still", busy_s=settings.busy_s) for _ in range(groups)]
    for number, host in enumerate(hosts):
        group = vehicles[number::groups]
        for vehicle, agent in zip(group, host.Agent.create(len(group)), strict=True):
            star.connect(vehicle, agent, "seen")
            star.connect(agent, vehicle, "command", time_shifted=True, initial_data={"command": COMMAND})
    with contextlib.suppress(EnoughError):
        star.run(until=END, print_progress=False)


if __name__ == "__main__":
    if sys.argv[1].startswith("--"):
        main(options())
    else:
        mosaik_api_v3.start_simulation(Still())
