"""Whole runs with bodies: physics, radio, in-process agents and recording together, each beside its building blocks.

``python -m bench.whole`` prints the table. CPU time of one core, medians of pairs; without start and files.
"""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bench import bare
from bench.crowds import RADIOS, team
from bench.measure import Row, in_turn, measured, table
from bench.vehicles import Fleet, bare_cpu_s
from bench.workloads import run_cpu_s, star
from vcmvsp.agents.patrol import Patrol
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Velocity, Waypoint

ROUNDS = 5


class Lookout(Patrol):
    """Patrols, and reads the scanner at every tick, in the air too."""

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint:
        """Read, and continue."""
        obs.readings.get(self.scanner)
        return super().act(obs, radio)


class Circler(Agent):
    """Drives a small circle like the robots of `bench.vehicles`, and broadcasts its position every second, at its own phase."""

    def start(self, info: VehicleInfo) -> None:
        """Note the time of the first report."""
        self._report_at_s = info.stream("report").uniform()

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Continue."""
        if obs.time_s >= self._report_at_s:
            self._report_at_s += 1.0
            x, y, z = obs.state.position
            radio.send(x=x, y=y, z=z)
        return Velocity(linear=(0.3, 0.0, 0.0), yaw_rate=0.3)


def built_in(name: str, duration_s: float, **changed: Mapping[str, Any]) -> dict[str, Any]:
    """A built-in scenario with in-process agents, another duration, and changed keys."""
    raw = tomllib.loads(scenarios.text_of(name))
    changed = {**changed, "agents": {"runs": "inprocess", **changed.get("agents", {})}}
    return {**raw, "duration_s": duration_s, **{key: {**raw.get(key, {}), **keys} for key, keys in changed.items()}}


def mixed_100(duration_s: float) -> dict[str, Any]:
    """mixed-50 with twice as many of each, in a town twice as long; all have scanners at 10 Hz and read them."""
    raw = built_in("mixed-50", duration_s, world={"size": [430.0, 200.0]}, metrics={"from_s": 0.0})
    ground, air = raw["vehicle"]
    ground |= {"count": 50, "columns": 10, "position": [-212.0, -92.0, 0.0]}
    air |= {"count": 50, "columns": 10, "position": [-180.0, -90.0, 45.0]}
    for vehicle, scanner in ((ground, "scan"), (air, "ring")):
        vehicle["sensors"][scanner]["rate_hz"] = 10.0
        vehicle["agent"] |= {"scanner": scanner}
    raw["agents"]["kind"] = "bench.whole:Lookout"
    return raw


def circling(fleet: Fleet) -> dict[str, Any]:
    """The robots of a fleet on its open floor."""
    listed = [{"name": spec.name, "position": spec.position, "agent": {}} for spec in fleet.specs()]
    return {
        "name": "circling",
        "duration_s": fleet.duration_s,
        "physics": {"rate_hz": fleet.rate_hz, "iterations": fleet.iterations},
        "radio": {"preset": "wifi-g-6"},
        "vehicles": {"kind": "p2dx"},
        "agents": {"kind": "bench.whole:Circler"},
        "vehicle": listed,
    }


def _speed(name: str, scenario: dict[str, Any], other: Callable[[], float], least: float) -> Row:
    """Speed of a run; ``other`` is the CPU time, s, of the peer for the same duration."""
    duration_s = scenario["duration_s"]
    our_s, other_s, ratio = in_turn(lambda: run_cpu_s(scenario), other, ROUNDS)
    speed = duration_s / our_s
    demand = f"goal: >= {least:g}x real time"
    return Row(name, f"{speed:.3g}x real time", f"{duration_s / other_s:.3g}x", ratio, demand, speed >= least)


def _swarm(report_s: float) -> Row:
    scenario = built_in("swarm-100", 3.0, radio={"mac": {"kind": "dcf"}}, agents={"report_s": report_s})
    name = f"whole run: swarm-100, 802.11g with contention, a report each every {report_s:g} s; beside stepSimulation"
    return _speed(name, scenario, lambda: 3.0 * bare_cpu_s(Fleet(0, 100)), 1.5)


def mixed() -> Row:
    """Fifty robots and fifty quadrotors with scanners."""
    name = "whole run: 50 p2dx, 50 quadrotors in a town, scans at 10 Hz, all read; beside stepSimulation on an open floor"
    return _speed(name, mixed_100(4.0), lambda: 4.0 * bare_cpu_s(Fleet(50, 50, duration_s=2.0)), 1.0)


def formation() -> Row:
    """formation-circle."""
    scenario = built_in("formation-circle", 60.0)
    name = "whole run: formation-circle, 3 p2dx; beside stepSimulation"
    return _speed(name, scenario, lambda: bare.bullet_cpu_s(3, 60.0), 30.0)


def kinematic() -> Row:
    """Ten vehicles without bodies."""
    scenario = star(10, physics="kinematic", duration_s=60.0)
    name = "whole run: 10 kinematic vehicles, 10 Hz, lossy 802.11b; beside SimPy waking 10 idle processes"
    return _speed(name, scenario, lambda: bare.simpy_cpu_s(10, 60.0), 150.0)


def thousand() -> Row:
    """A thousand vehicles without bodies; each is in range of its thirty nearest."""
    scenario = team({"kinematic": 1000}, 2.0, RADIOS["802.11g with contention"], 5.0)
    for number, vehicle in enumerate(scenario["vehicle"]):
        vehicle["position"] = (25.0 * (number % 32), 25.0 * (number // 32), 0.0)
    scenario["agents"]["period_s"] = 0.5
    scenario["record"] = {"least_rssi_dbm": -86.0}
    name = "whole run: 1000 kinematic vehicles, 2 Hz, 802.11g, 30 neighbours each; beside SimPy waking 1000 idle processes"
    return _speed(name, scenario, lambda: bare.simpy_cpu_s(1000, 5.0), 1.0)


def with_rays(world: Mapping[str, Any], places: Sequence[tuple[float, float]], reflections: int) -> dict[str, Any]:
    """Vehicles without bodies that report at 10 Hz, for 10 s."""
    way = [(2.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    return {
        "name": "rays",
        "duration_s": 10.0,
        "physics": {"kind": "kinematic"},
        "world": world,
        "radio": {"preset": "wifi-g-6", "path_loss": {"kind": "rays", "frequency_hz": 2.437e9, "reflections": reflections}},
        "vehicles": {"kind": "kinematic"},
        "agents": {"kind": "patrol", "way": way, "relative": True, "speed": 1.0, "period_s": 0.1, "report_s": 0.1},
        "vehicle": [{"name": f"v{k}", "position": (*place, 0.0), "agent": {}} for k, place in enumerate(places)],
    }


def town_of(blocks: tuple[int, int]) -> dict[str, Any]:
    """Thirty vehicles with rays in the streets of a town with four buildings in each block."""
    size = [46.0 * count + 10.0 for count in blocks]
    rows = [46.0 * k + 5.0 - 0.5 * size[1] for k in range(blocks[1] + 1)]
    places = [((k + 0.5) / 30.0 * (size[0] - 20.0) - 0.5 * size[0] + 8.0, rows[k % len(rows)]) for k in range(30)]
    return with_rays({"kind": "urban", "size": size, "density": 1.0, "seed": 1}, places, 1)


def _rays(name: str, scenario: dict[str, Any], least: float) -> Row:
    """Rays beside the same with a law of distance."""
    plain = {**scenario, "radio": {"preset": "wifi-g-6"}}
    run_cpu_s({**scenario, "duration_s": 1.0})  # compiles if the cache is empty
    name = f"whole run: 30 kinematic vehicles, 10 Hz, rays among {name}; beside log-distance"
    return _speed(name, scenario, lambda: run_cpu_s(plain), least)


def canyon() -> Row:
    """Rays between the buildings of relay-canyon."""
    places = [(7.0 * k - 85.0, 3.0 * (k % 3 - 1)) for k in range(20)]
    places += [(60.0, 8.0 + 12.0 * k) for k in range(5)]
    places += [(70.0 + 12.0 * k, 80.0) for k in range(5)]
    scenario = with_rays(built_in("relay-canyon", 1.0)["world"], places, 2)
    return _rays("six buildings, two reflections and diffraction", scenario, 2.0)


def town() -> Row:
    """Rays in a town."""
    return _rays("100 buildings, one reflection and diffraction", town_of((5, 5)), 1.0)


def robots() -> Row:
    """Fifty robots beside Bullet's own steps."""
    fleet = Fleet(50, 0)
    ours, other, ratio = in_turn(lambda: run_cpu_s(circling(fleet)), lambda: fleet.duration_s * bare_cpu_s(fleet), ROUNDS)
    speeds = [f"{fleet.duration_s / cost:.1f}x" for cost in (ours, other)]
    name = "whole run: 50 p2dx on circles, reports every second, 802.11g; beside stepSimulation of the same"
    return Row(name, f"{speeds[0]} real time", speeds[1], ratio, "<= 1.6", ratio <= 1.6)


def swarm_1() -> Row:
    """swarm-100 unchanged."""
    return _swarm(1.0)


def swarm_10() -> Row:
    """Ten times as many messages."""
    return _swarm(0.1)


ALL: Sequence[Callable[[], Row]] = (swarm_1, swarm_10, mixed, formation, kinematic, thousand, canyon, town, robots)


def rows() -> list[Row]:
    """All rows."""
    return measured(ALL)


if __name__ == "__main__":
    print(table(rows()))
