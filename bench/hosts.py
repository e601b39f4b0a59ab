"""Whole runs whose agents are in two other processes, beside the same run in one: ``python -m bench.hosts``.

The agents are light, so that the cost of communication between processes shows. Wall-clock seconds from the first instant to
the last, without start and end.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bench.measure import Row, in_turn, measured, table
from vcmvsp.cosim.runs import api

ROUNDS = 3
HOSTS = 2
MOST = 2.0
ELSEWHERE: Mapping[str, Any] = {"agents.runs": "process", "agents.processes": HOSTS}


def swarm() -> Row:
    """Quadrotors in Bullet, 802.11."""
    return _row("swarm-100", "100 quadrotors", 4.0)


def circle() -> Row:
    """Three robots that send ten times a second."""
    return _row("formation-circle", "3 robots", 20.0)


def column() -> Row:
    """Vehicles without bodies."""
    return _row("study-size", "20 kinematic vehicles", 20.0)


def _row(scenario: str, fleet: str, duration_s: float) -> Row:
    def wall_s(**settings: Any) -> float:
        result = api.run(scenario, set={"duration_s": duration_s, **settings})
        return float(result.about["simulating_s"])

    ours, other, ratio = in_turn(lambda: wall_s(**ELSEWHERE), lambda: wall_s(**{"agents.runs": "inprocess"}), ROUNDS)
    name = f"`{scenario}`, {fleet}, {duration_s:g} s, agents in {HOSTS} host processes; beside all in one process"
    return Row(name, f"{ours:.2f} wall s", f"{other:.2f}", ratio, f"< {MOST:g}x", ratio < MOST)


ALL: Sequence[Callable[[], Row]] = (swarm, circle, column)


def rows() -> list[Row]:
    """All rows."""
    return measured(ALL)


if __name__ == "__main__":
    print(table(rows()))
