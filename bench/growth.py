"""Growth of cost with the number of vehicles: each part of a run, its start and its memory, as N doubles.

``python -m bench.growth [FOLDER]`` prints the table and leaves growth.csv, .json, .png and .svg in the folder. Every vehicle
drives a circle of its own and broadcasts at 10 Hz: where all hear all, receptions grow as N squared. Each N is a process of
its own, whose CPU time is read part by part; exponents are slopes of straight lines through the logarithms.
"""

import io
import json
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bench.measure import Row, peak_mib, table
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.scenario import loader as scenarios

COUNTS = (10, 20, 40, 80)
DURATION_S = 4.0
HANDOVER_S = 0.05  # over which the reports of an instant are spread: in the default 2 ms most collide
PARTS = {"physics": "physics", "netsim": "radio", "agents": "agents"}  # by package of the federate


class Case(NamedTuple):
    """Vehicles, their radio, and the largest exponent of each part: its work grows by N or by N squared."""

    physics: str
    preset: str
    demands: Mapping[str, float]


EACH, PAIRS = 1.4, 2.3  # exponents: work done once per vehicle, and for each pair of them
SHARED = {"agents": PAIRS, "kernel": PAIRS, "recording": PAIRS}
CASES = {
    "kinematic, ideal radio": Case("kinematic", "ideal", {"physics": EACH, "radio": PAIRS, **SHARED}),
    "PyBullet, 802.11g": Case("bullet", "wifi-g-24", {"physics": EACH, "radio": PAIRS, **SHARED}),
}


def crowd(count: int, physics: str, preset: str, duration_s: float) -> dict[str, Any]:
    """Vehicles 4 m apart on circles of 0.5 m, each of which broadcasts at 10 Hz."""
    side = int(np.ceil(np.sqrt(count)))
    agent = {"kind": "trajectory", "path": "circle", "speed": 0.2, "yaw_rate": 0.4}
    vehicles = []
    for number in range(count):
        place = 4.0 * (number % side), 4.0 * (number // side), 0.0
        vehicles.append({"name": f"car{number}", "pose": place, "agent": agent})
    return {
        "name": "crowd",
        "duration_s": duration_s,
        "physics": {"kind": physics},
        "radio": {"preset": preset, "handover_s": HANDOVER_S},
        "vehicles": {"kind": "kinematic" if physics == "kinematic" else "p2dx"},
        "agents": {"period_s": 0.1},
        "vehicle": vehicles,
    }


def costs(scenario: dict[str, Any]) -> dict[str, float]:
    """Costs of one run in this process: CPU s per simulated s by part; of its start, s and MiB; bytes of run.mcap per event.

    Also the share of frames that arrived, receiver by receiver. The first quarter of the run is not counted: modules and code
    are loaded then.
    """
    begin = time.process_time()
    parsed, source = scenarios.load(scenario)
    spent = dict.fromkeys((*PARTS.values(), "recording"), 0.0)
    with assemble(parsed, source) as assembled:
        kernel = Kernel(assembled.info, [_timed(each, spent) for each in assembled.federates])
        kernel.start()
        stream, events = io.BytesIO(), 0
        recorder = assembled.recorder(stream)
        found = {"start": time.process_time() - begin, "start_mib": peak_mib()}
        counted_from = assembled.info.duration_ns // 4
        counts = False

        def on(event: Event) -> None:
            nonlocal events
            before = time.process_time()
            recorder.on(event)
            spent["recording"] += time.process_time() - before
            events += 1

        def instant(now_ns: int) -> None:
            nonlocal begin, counts
            if not counts and now_ns >= counted_from:
                counts = True
                spent.update(dict.fromkeys(spent, 0.0))
                begin = time.process_time()

        kernel.run(on, on_instant=instant)
        whole = time.process_time() - begin
        recorder.close(kernel.now_ns)
        kernel.close()
    span_s = 0.75 * scenario["duration_s"]
    found["kernel"] = (whole - sum(spent.values())) / span_s
    found |= {part: seconds / span_s for part, seconds in spent.items()}
    outcomes = recorder.radio["outcome"].to_pylist()
    arrived = outcomes.count("received") / max(1, len(outcomes))
    return {**found, "whole": whole / span_s, "event_bytes": stream.tell() / events, "arrived": arrived}


def case_costs(count: int, case: Case) -> dict[str, float]:
    """Costs of a run of a crowd."""
    return costs(crowd(count, case.physics, case.preset, DURATION_S))


def _timed(federate: Any, spent: dict[str, float]) -> Any:
    """The federate with timed steps; steps of the core itself count for the kernel."""
    part, step = PARTS.get(type(federate).__module__.removeprefix("vcmvsp.").partition(".")[0]), federate.step
    if part is None:
        return federate

    def clocked(now_ns: int, inbox: Sequence[Event]) -> Any:
        begin = time.process_time()
        result = step(now_ns, inbox)
        spent[part] += time.process_time() - begin
        return result

    federate.step = clocked
    return federate


def measured() -> dict[str, dict[str, list[float]]]:
    """Each cost of every case, by `COUNTS`."""
    return {name: measured_case(name) for name in CASES}


def measured_case(name: str) -> dict[str, list[float]]:
    """Each cost by `COUNTS`, with progress."""
    found: dict[str, list[float]] = {}
    for count in COUNTS:
        print(f"measuring: growth, {name}, {count} vehicles ...", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "bench.growth", "--one", name, str(count)]
        answer = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
        for part, cost in answer.items():
            found.setdefault(part, []).append(cost)
    return found


def exponent(cost: Sequence[float]) -> float:
    """The slope of a straight line through the logarithms, over `COUNTS`."""
    return float(np.polyfit(np.log(COUNTS), np.log(np.maximum(cost, 1e-9)), 1)[0])


def table_of(found: Mapping[str, Mapping[str, Sequence[float]]]) -> list[Row]:
    """Cost at the most and at the fewest vehicles, and the exponent between them."""
    made = []
    for name, costs_of in found.items():
        for part, most in CASES[name].demands.items():
            cost = costs_of[part]
            made.append(_row(f"{name}: {part}, CPU s per simulated s", cost, "", exponent(cost), f"~ N^{most:g} at most", most))
        made.append(_row(f"{name}: start", costs_of["start"], " s", exponent(costs_of["start"]), f"~ N^{EACH:g} at most", EACH))
        size = costs_of["event_bytes"]
        made.append(_row(f"{name}: bytes of run.mcap per event", size, " B", exponent(size), "~ N^1 at most", 1.0))
        each_mib = float(np.polyfit(COUNTS, costs_of["start_mib"], 1)[0])
        title = f"{name}: memory after the start; ratio: MiB per vehicle"
        made.append(_row(title, costs_of["start_mib"], " MiB", each_mib, "<= 1 MiB per vehicle", 1.0))
    return made


def _row(quantity: str, cost: Sequence[float], unit: str, ratio: float, demand: str, most: float) -> Row:
    name = f"{quantity}; {COUNTS[-1]} vehicles beside {COUNTS[0]}"
    return Row(name, f"{cost[-1]:.3g}{unit}", f"{cost[0]:.3g}{unit}", ratio, demand, ratio <= most)


def draw(found: Mapping[str, Mapping[str, Sequence[float]]], folder: Path) -> list[Path]:
    """The costs over N, on logarithmic axes."""
    from PIL import Image

    from vcmvsp.cosim.reproduction.figures import drawing
    from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel

    panels = []
    for name, costs_of in found.items():
        curves = []
        for color, part in enumerate(("whole", *CASES[name].demands)):
            cost = np.array(costs_of[part])
            curves.append(Curve(np.array(COUNTS), cost, f"{part}, N^{exponent(cost.tolist()):.2f}", color, "both"))
        panels.append(Panel(name, "vehicles", "CPU s per simulated s", curves, log_x=True, log_y=True))
    figure = Figure("Cost by the number of vehicles, each of which broadcasts at 10 Hz", panels, ())
    written = drawing.write("growth", figure, folder)
    for path in written:
        if path.suffix == ".png":  # for a page: no more colours than needed
            Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)
    return written


def rows() -> list[Row]:
    """All rows."""
    return table_of(measured())


def main(arguments: Sequence[str]) -> None:
    """Print the table and draw it; or, with ``--one CASE N``, the costs of one run as JSON."""
    if arguments[:1] == ["--one"]:
        print(json.dumps(case_costs(int(arguments[2]), CASES[arguments[1]])))
        return
    print(f"{platform.processor() or platform.machine()}, Python {platform.python_version()}\n")
    found = measured()
    print(table(table_of(found)))
    print("\n".join(map(str, draw(found, Path(*arguments) if arguments else Path("growth")))))


if __name__ == "__main__":
    main(sys.argv[1:])
