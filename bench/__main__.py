"""Times the platform beside its building blocks and peers in one run, and prints the ratios.

CPU seconds wherever one process does the work; wall-clock time only for the round trip between two processes. Medians of
pairs: compare the ratios, since machines differ and drift. Exit code 1 if a demand is missed. ``--help`` names the parts.
"""

import argparse
import contextlib
import itertools
import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Literal
from unittest import mock

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
    rays,
    recording,
    scanner,
    sensors,
    shares,
    stacks,
    start,
    studies,
    vehicles,
    view,
    whole,
)
from bench.measure import Row, in_turn, measured, table
from bench.workloads import run_cpu_s, star
from vcmvsp.agents.federate import AgentHost
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.hosts.hub import Hub
from vcmvsp.cosim.hosts.remote_host import RemoteHost
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.util.files import finite

ROUNDS = 5


def kernel_row() -> Row:
    """Ten kinematic vehicles with all services, beside SimPy alone."""
    duration_s = 60.0
    scenario = star(10, physics="kinematic", duration_s=duration_s)
    ours, other, ratio = in_turn(lambda: run_cpu_s(scenario), lambda: bare.simpy_cpu_s(10, duration_s), ROUNDS)
    speed = duration_s / ours
    name = "10 kinematic vehicles, 10 Hz, star broadcast, recorded, in-process; beside SimPy waking 10 idle processes"
    return Row(
        name, f"{speed:.0f} sim s / CPU s", f"{duration_s / other:.0f}", ratio, "goal: >= 100 sim s / CPU s", speed >= 100.0
    )


def bullet_row() -> Row:
    """Three Pioneers with radio and agents, beside stepSimulation alone."""
    duration_s = 30.0
    scenario = star(3, physics="bullet", duration_s=duration_s)
    ours, other, ratio = in_turn(lambda: run_cpu_s(scenario), lambda: bare.bullet_cpu_s(3, duration_s), ROUNDS)
    speed = duration_s / ours
    name = "3 p2dx in PyBullet with radio, in-process agents, recorded; beside stepSimulation alone"
    return Row(
        name, f"{speed:.0f} sim s / CPU s", f"{duration_s / other:.0f}", ratio, "goal: >= 20 sim s / CPU s", speed >= 20.0
    )


def federation_row() -> Row:
    """A round with ten agents in another process, beside a bare query and reply of the same sizes."""
    rounds, scenario = 300, star(10, physics="kinematic", duration_s=10.0)
    scenario["agents"] = {"period_s": 0.1, "processes": 1}
    with _after_run(scenario, "inprocess") as (local, _, _), _after_run(scenario, "process") as (remote, inboxes, sizes):
        query_size, reply_size = sizes
        ticks = itertools.count(len(inboxes) + 1)

        def ours() -> float:
            elsewhere_s = here_s = 0.0
            for tick in itertools.islice(ticks, rounds):  # time advances, so that agents have ticks; inboxes repeat
                question = (round(tick * 1e8), inboxes[tick % len(inboxes)])
                begin = time.perf_counter()
                remote.step(*question)
                middle = time.perf_counter()
                local.step(*question)
                elsewhere_s += middle - begin
                here_s += time.perf_counter() - middle
            return (elsewhere_s - here_s) / rounds

        hub = Hub()
        with bare.zenoh_echo(hub.endpoint, reply_size):
            payload = bare.payload(query_size)

            def other() -> float:
                begin = time.perf_counter()
                for _ in range(rounds):
                    bare.ask(hub.session, payload)
                return (time.perf_counter() - begin) / rounds

            our_s, other_s, ratio = in_turn(ours, other, 9)
        hub.close()
    name = (
        "federation round, 10 agents in one host process, less their step in this process; "
        f"beside it a bare Zenoh request ({query_size} B) and answer ({reply_size} B)"
    )
    return Row(name, f"{1e6 * our_s:.0f} us", f"{1e6 * other_s:.0f} us", ratio, "<= 2x", ratio <= 2.0)


@contextlib.contextmanager
def _after_run(
    scenario: dict[str, object], runs: Literal["inprocess", "process"]
) -> Iterator[tuple[RemoteHost | AgentHost, list[Sequence[Event]], tuple[int, int]]]:
    """Agent host after a run; its inbox at each tick; median size, bytes, of query and reply, if sent."""
    inboxes: list[Sequence[Event]] = []
    query_sizes, reply_sizes = [0], [0]
    parsed, source = scenarios.load(scenario)
    with assemble(parsed, source, runs=runs) as assembled:
        host = next(each for each in assembled.federates if isinstance(each, RemoteHost | AgentHost))
        take = host.ask if isinstance(host, RemoteHost) else host.step

        def noted(now_ns: int, inbox: Sequence[Event]) -> object:
            inboxes.append(inbox)
            return take(now_ns, inbox)

        with contextlib.ExitStack() as stack:
            stack.enter_context(mock.patch.object(host, take.__name__, noted))
            if isinstance(host, RemoteHost):
                link = host._crews[0].link
                link_ask, link_answer = link.ask, link.answer

                def ask(question: bytes, deadline_s: float) -> None:
                    query_sizes.append(len(question))
                    link_ask(question, deadline_s)

                def answer() -> bytes:
                    content = link_answer()
                    reply_sizes.append(len(content))
                    return content

                stack.enter_context(mock.patch.multiple(link, ask=ask, answer=answer))
            kernel = Kernel(assembled.info, assembled.federates)
            kernel.start()
            kernel.run(lambda _: None)
        yield host, inboxes, (round(statistics.median(query_sizes)), round(statistics.median(reply_sizes)))
        kernel.close()


def rows() -> list[Row]:
    """Rows of the core."""
    return measured((kernel_row, bullet_row, federation_row))


PARTS: Mapping[str, Callable[[], Iterable[Row]]] = {
    "core": rows,
    **{
        part.__name__.rpartition(".")[2]: part.rows
        for part in (
            *(
                start,
                whole,
                shares,
                radio,
                rays,
                messages,
                vehicles,
                sensors,
                drones,
                scanner,
                camera,
                avoidance,
                mission,
                studies,
            ),
            *(view, hosts, federation, bridge, stacks, recording, learning, growth, limits),
        )
    },
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(prog="python -m bench", description="What the platform costs.")
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} [all]")
    parser.add_argument("--json", action="store_true", help="print JSON")
    options = parser.parse_args(arguments)
    if unknown := [part for part in options.parts if part not in PARTS]:
        parser.error(f"there is no part {unknown[0]!r}; parts: {', '.join(PARTS)}")
    found: list[tuple[str, Row]] = []
    complete = True
    try:
        for name in options.parts or PARTS:
            print(f"measuring: {name} ...", file=sys.stderr, flush=True)
            begin = time.monotonic()
            found.extend((name, row) for row in PARTS[name]())
            print(f"measured: {name}, in {time.monotonic() - begin:.0f} s", file=sys.stderr, flush=True)
    except KeyboardInterrupt:
        print("interrupted: this is what was measured until then", file=sys.stderr)
        complete = False
    machine = f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}"
    if options.json:
        records = [finite({"part": name, **row._asdict()}) for name, row in found]  # no ratio to a missing peer
        print(json.dumps({"schema": "vcmvsp.bench/1", "machine": machine, "rows": records}, indent=2))
    else:
        rows = [row for _, row in found]
        print(f"{machine}\n\n{table(rows)}")
    holds = all(row.holds or row.is_goal for _, row in found)
    return 0 if complete and holds else 1


if __name__ == "__main__":
    sys.exit(main())
