"""Times the platform and what it is built on in turn, in one run, and prints the ratios.

CPU seconds wherever one process does the work; wall-clock time only for the round trip between two processes. Medians of
pairs: read the ratios, since machines differ and drift. Exit code 1 if a demand is missed. ``--help`` names the parts.
"""

import argparse
import contextlib
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from bench import (
    avoidance,
    bare,
    bridge,
    camera,
    drones,
    federation,
    growth,
    hosts,
    learning,
    limits,
    messages,
    mission,
    radio,
    recording,
    scanner,
    sensors,
    shares,
    start,
    studies,
    vehicles,
    view,
    whole,
)
from bench.measure import Row, in_turn, measured, table
from bench.workloads import run_cpu_s, star
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.hosts.hub import Hub
from vcmvsp.cosim.hosts.remote_host import RemoteHost
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.util.files import finite

ROUNDS = 5
Question = tuple[int, Sequence[Event]]


def kernel_row() -> Row:
    """Ten kinematic vehicles, everything on: against SimPy alone."""
    duration_s = 60.0
    scenario = star(10, physics="kinematic", duration_s=duration_s)
    ours, other, ratio = in_turn(lambda: run_cpu_s(scenario), lambda: bare.simpy_cpu_s(10, duration_s), ROUNDS)
    speed = duration_s / ours
    name = "10 kinematic vehicles, 10 Hz, star broadcast, recorded, in-process; beside it SimPy waking 10 idle processes"
    return Row(
        name, f"{speed:.0f} sim s / CPU s", f"{duration_s / other:.0f}", ratio, "goal: >= 100 sim s / CPU s", speed >= 100.0
    )


def bullet_row() -> Row:
    """Three Pioneers with radio and agents: against stepSimulation alone."""
    duration_s = 30.0
    scenario = star(3, physics="bullet", duration_s=duration_s)
    ours, other, ratio = in_turn(lambda: run_cpu_s(scenario), lambda: bare.bullet_cpu_s(3, duration_s), ROUNDS)
    speed = duration_s / ours
    name = "3 p2dx in PyBullet with radio, in-process agents, recorded; beside it stepSimulation alone"
    return Row(
        name, f"{speed:.0f} sim s / CPU s", f"{duration_s / other:.0f}", ratio, "goal: >= 20 sim s / CPU s", speed >= 20.0
    )


def federation_row() -> Row:
    """One round with ten agents in another process: against a bare request and answer of the same bytes."""
    rounds = 300
    with _remote_host(star(10, physics="kinematic", duration_s=10.0)) as (host, questions, sizes):
        asked, answered = sizes

        def ours() -> float:
            begin = time.perf_counter()
            for number in range(rounds):
                host.ask(*questions[number % len(questions)])
                host.answer()
            return (time.perf_counter() - begin) / rounds

        hub = Hub()
        with bare.zenoh_echo(hub.endpoint, answered):
            question = bare.payload(asked)

            def other() -> float:
                begin = time.perf_counter()
                for _ in range(rounds):
                    bare.ask(hub.session, question)
                return (time.perf_counter() - begin) / rounds

            mine, its, ratio = in_turn(ours, other, 9)
        hub.close()
    name = (
        f"federation round, 10 agents in one host process; beside it a bare Zenoh request ({asked} B) and answer ({answered} B)"
    )
    return Row(name, f"{1e6 * mine:.0f} us", f"{1e6 * its:.0f} us", ratio, "<= 2x", ratio <= 2.0)


@contextlib.contextmanager
def _remote_host(scenario: dict[str, object]) -> Iterator[tuple[RemoteHost, list[Question], tuple[int, int]]]:
    """A host process with the scenario's agents; the questions of a run of it; the median bytes of question and answer."""
    questions: list[Question] = []
    sizes: list[tuple[int, int]] = []
    scenario["agents"] = {"period_s": 0.1, "processes": 1}
    parsed, source = scenarios.load(scenario)
    with assemble(parsed, source, runs="process") as assembled:
        host = next(each for each in assembled.federates if isinstance(each, RemoteHost))
        link, ask = host._crews[0].link, host.ask
        link_ask, link_answer = link.ask, link.answer

        def note_question(now_ns: int, inbox: Sequence[Event]) -> int | None:
            questions.append((now_ns, inbox))
            return ask(now_ns, inbox)

        def note_size(question: bytes, deadline_s: float) -> None:
            sizes.append((len(question), 0))
            link_ask(question, deadline_s)

        def note_answer() -> bytes:
            answer = link_answer()
            sizes[-1] = (sizes[-1][0], len(answer))
            return answer

        host.ask, link.ask, link.answer = note_question, note_size, note_answer  # type: ignore[method-assign]
        kernel = Kernel(assembled.info, assembled.federates)
        kernel.start()
        kernel.run(lambda _: None)
        del host.ask, link.ask, link.answer
        middle = sorted(sizes)[len(sizes) // 2]
        yield host, questions, middle
        kernel.close()


def rows() -> list[Row]:
    """The core's own."""
    return measured((kernel_row, bullet_row, federation_row))


PARTS: Mapping[str, Callable[[], Iterable[Row]]] = {
    "core": rows,
    **{
        part.__name__.rpartition(".")[2]: part.rows
        for part in (
            *(start, whole, shares, radio, messages, vehicles, sensors, drones, scanner, camera, avoidance, mission, studies),
            *(view, hosts, federation, bridge, recording, learning, growth, limits),
        )
    },
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench", description="What the platform costs.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} [all]")
    parser.add_argument("--json", action="store_true", help="print JSON")
    given = parser.parse_args(arguments)
    if unknown := [part for part in given.parts if part not in PARTS]:
        parser.error(f"there is no part {unknown[0]!r}; parts: {', '.join(PARTS)}")
    found: list[tuple[str, Row]] = []
    complete = True
    try:
        for name in given.parts or PARTS:
            print(f"measuring: {name} ...", file=sys.stderr, flush=True)
            begin = time.monotonic()
            found.extend((name, row) for row in PARTS[name]())
            print(f"measured: {name}, in {time.monotonic() - begin:.0f} s", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        print("interrupted: this is what was measured until then", file=sys.stderr)
        complete = False
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    if given.json:
        told = [finite({"part": name, **row._asdict()}) for name, row in found]  # no ratio to what is not there
        print(json.dumps({"schema": "vcmvsp.bench/1", "machine": machine, "rows": told}, indent=2))
    else:
        print(f"{machine}\n\n{table([row for _, row in found])}")
    return 0 if complete and all(row.holds or row.is_goal for _, row in found) else 1


if __name__ == "__main__":
    sys.exit(main())
