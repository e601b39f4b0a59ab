"""Limits of one core, one hub and one disk, and the gain of each way past them: the tables of ``cosim/SCALING.md``.

``python -m bench.limits`` prints them; with ``--markdown`` they are put into the document, between the comments that bear
their names, so that no figure is typed. Vehicles cost CPU time of one process; hosts and studies are timed by the wall clock,
and need the machine for themselves.
"""

import argparse
import math
import os
import platform
import re
import statistics
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

from bench import messages, recording
from bench.asked import program
from bench.crowds import RADIOS, Reached, reach, team
from bench.federation import HERE
from bench.growth import COUNTS, PARTS, costs, measured_case
from bench.limits_files import Sizes, resident, sizes
from bench.limits_ways import ways
from bench.measure import Row
from bench.ns3.cases import Case
from bench.radio import _ours_s
from bench.whole import town_of
from bench.workloads import run_cpu_s

DOCUMENT = Path(__file__).resolve().parent.parent / "cosim" / "SCALING.md"
KINDS = ("kinematic", "p2dx", "quadrotor")
FIRST = {10.0: 96, 1.0: 160}  # number of vehicles tried first, by broadcasts a second
RUN_S = 1.5
HOSTS = ((1, 1), (2, 2), (4, 4), (8, 8), (16, 16), (32, 32), (8, 1), (32, 1), (128, 1), (512, 1))  # agents, host processes
STRETCHES = 3
TALKING = 100  # vehicles, of the table of frames
TICKS = 10
TOWNS = ((1, 3), (2, 4), (5, 5), (9, 8), (16, 16))  # blocks of four buildings


class Section(NamedTuple):
    """A table of the document."""

    name: str  # of its place in the document
    columns: Sequence[str]
    lines: Sequence[Sequence[str]]

    @property
    def markdown(self) -> str:
        """The section in Markdown."""
        rows = [self.columns, ["---"] * len(self.columns), *self.lines]
        return "\n".join(f"| {' | '.join(row)} |" for row in rows)

    @property
    def rows(self) -> list[Row]:
        """Lines of the table that all parts of `bench` share."""
        return [self._row(line) for line in self.lines]

    def _row(self, line: Sequence[str]) -> Row:
        figures = "; ".join(f"{column}: {cell}" for column, cell in zip(self.columns[1:], line[1:], strict=True))
        return Row(f"limits, {self.name}: {line[0]}", figures, "", math.nan, "none", True)


def vehicles() -> Section:
    """Number of vehicles that cost a core as much time as is simulated."""
    lines = []
    for kind in KINDS:
        for hz, first in FIRST.items():
            for name in RADIOS:
                _tell(f"{kind}, {hz:g} Hz, {name}")
                found = reach(partial(_cost, kind, hz, name), first)
                lines.append((f"{kind}, {hz:g} Hz, {name}", found.words, *_shares(found, kind, hz, name)))
    columns = ("vehicle, broadcasts of each, radio", "vehicles at real time (measured: CPU s per simulated s)")
    return Section("vehicles", (*columns, "most of it goes into", "frames that arrived"), lines)


def _cost(kind: str, hz: float, radio: str, count: int) -> float:
    """CPU s per simulated s of a number of vehicles."""
    return run_cpu_s(team({kind: count}, hz, RADIOS[radio], RUN_S)) / RUN_S


def _shares(found: Reached, kind: str, hz: float, radio: str) -> tuple[str, str]:
    """The three most expensive parts at the nearest measured number; the share of frames that arrived."""
    count = min(found.measured, key=lambda each: abs(each - found.number))
    spent = costs(team({kind: count}, hz, RADIOS[radio], RUN_S))
    parts = sorted((*PARTS.values(), "recording", "kernel"), key=lambda part: -spent[part])[:3]
    return ", ".join(f"{part} {spent[part] / spent['whole']:.0%}" for part in parts), f"{spent['arrived']:.0%}"


def hosts() -> Section:
    """Wall-clock time of a step with agents in other processes."""
    lines = []
    for agents, processes in HOSTS:
        name = f"{processes} x {agents // processes}"
        _tell(f"hosts, {name}")
        with program("ours", HERE, agents=agents, processes=processes) as step:
            seconds = agents * statistics.median(step() for _ in range(STRETCHES))
        each = f"{1e6 * seconds / processes:.0f} us", f"{1e6 * seconds / agents:.1f} us"
        lines.append((name, f"{1e3 * seconds:.2f} ms", *each))
    return Section("hosts", ("host processes x agents in each", "a step", "per host", "per agent"), lines)


def frames() -> Section:
    """Frames and receptions a CPU second: the channel alone, and a whole recorded run."""
    lines = []
    for name, radio in (("ideal radio", messages.IDEAL), ("802.11b levels, no contention", messages.LEVELS)):
        _tell(f"frames, {name}")
        send = messages.sends(TALKING, radio, TICKS)
        send()
        lines.append(
            _speeds(
                f"`Channel.send` alone, all move, {name}", TALKING * TICKS, statistics.median(send() for _ in range(STRETCHES))
            )
        )
    _tell("frames, contention")
    case = Case("g-6", TALKING, 10.0)
    seconds = statistics.median(_ours_s(case, compiled=True) for _ in range(STRETCHES))
    lines.append(_speeds("`vcmvsp channel`, all at rest, 802.11g with contention", int(10.0 * TALKING * 5.0), seconds))
    for name, preset in RADIOS.items():
        _tell(f"frames, whole run, {name}")
        scenario = team({"kinematic": TALKING}, 10.0, preset, RUN_S)
        seconds = statistics.median(run_cpu_s(scenario) for _ in range(STRETCHES))
        lines.append(_speeds(f"whole run, kinematic, recorded, {name}", int(10.0 * TALKING * RUN_S), seconds))
    return Section("frames", (f"{TALKING} vehicles, 10 Hz each", "frames / CPU s", "receptions decided / CPU s"), lines)


def _speeds(label: str, count: int, seconds: float) -> tuple[str, str, str]:
    return label, f"{count / seconds:,.0f}", f"{count * (TALKING - 1) / seconds / 1e6:.2f} million"


def files() -> Section:
    """Size of a run's files, and its memory during the run."""
    _tell("files")
    found: Sizes = sizes()
    _tell("memory")
    held, _ = recording._bytes_per_row()
    most = resident()
    begun = measured_case("PyBullet, 802.11g")["start_mib"]
    each_kib = 1024.0 * (begun[-1] - begun[0]) / (COUNTS[-1] - COUNTS[0])
    lines = [
        ("`run.mcap`", f"{found.mcap_state:.0f} B", f"{found.mcap_reception:.0f} B"),
        ("`states.parquet`", f"{found.states_state:.0f} B", ""),
        ("`radio.parquet`", "", f"{found.radio_reception:.1f} B"),
        ("memory while it goes on", "", f"{held:.0f} B"),
        ("resident memory at most, at its end", f"{10.0 * most.state:.0f} B", f"{most.reception:.0f} B"),
        (f"memory at its start, p2dx: {begun[0]:.0f} MiB for {COUNTS[0]}", f"{each_kib:.0f} KiB a vehicle", ""),
    ]
    return Section("files", ("", "a vehicle and simulated second, states at 10 Hz", "a frame and receiver"), lines)


def buildings() -> Section:
    """Cost of the rays of thirty vehicles by the number of buildings."""
    lines = []
    for blocks in TOWNS:
        count = 4 * blocks[0] * blocks[1]
        _tell(f"rays, {count} buildings")
        scenario = town_of(blocks)
        short = {**scenario, "duration_s": 1.0}
        plain = {**short, "radio": {"preset": "wifi-g-6"}}
        run_cpu_s(short)  # compiles if the cache is empty
        begin, whole, rest = run_cpu_s(short), run_cpu_s(scenario), run_cpu_s(plain)
        each_s = (whole - begin) / (scenario["duration_s"] - 1.0)
        lines.append((f"{count}", f"{each_s:.2f} CPU s", f"{rest:.2f} CPU s", f"{max(begin - each_s, 0.0):.1f} CPU s"))
    columns = ("buildings", "a simulated second with rays", "with log-distance", "once, for what is seen from where")
    return Section("buildings", columns, lines)


def changes() -> Section:
    """Gain of each way past the limits."""
    lines = [(way.label, way.ours, way.other, f"{way.ratio:.2f}") for way in ways(_tell)]
    return Section("changes", ("", "with it", "without it", "ratio"), lines)


SECTIONS: Sequence[Callable[[], Section]] = (vehicles, hosts, frames, buildings, files, changes)


def rows() -> Iterator[Row]:
    """All rows; each section is measured when it is requested."""
    for section in SECTIONS:
        yield from section().rows


def placed(text: str, contents: Mapping[str, str]) -> str:
    """The document with these texts at their places.

    Raises:
        ValueError: a name has no place there.
    """
    for name, content in contents.items():
        mark = f"(<!-- measured: {name} -->\n).*?(<!-- end -->)"
        parts = re.split(mark, text, flags=re.DOTALL)
        if len(parts) != 4:
            raise ValueError(f"{len(parts) // 3} places for '{name}'")
        text = f"{parts[0]}{parts[1]}{content}\n{parts[2]}{parts[3]}"
    return text


def _machine() -> str:
    when = datetime.now(UTC).date().isoformat()
    return f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, {when}."


def _tell(label: str) -> None:
    print(f"measuring: limits, {label} ...", file=sys.stderr, flush=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables, and put them into the document on request."""
    parser = argparse.ArgumentParser(prog="python -m bench.limits", description="How far one core and one hub carry.")
    names = {section.__name__: section for section in SECTIONS}
    parser.add_argument("sections", nargs="*", metavar="SECTION", help=f"of {', '.join(names)} [all]")
    parser.add_argument("--markdown", action="store_true", help=f"put the tables into {DOCUMENT.name}")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.sections if name not in names]:
        parser.error(f"there is no section {unknown[0]!r}; sections: {', '.join(names)}")
    found = [names[name]() for name in options.sections or names]
    for section in found:
        print(f"{section.markdown}\n")
    if options.markdown:
        contents = {section.name: section.markdown for section in found}
        if not options.sections:
            contents["machine"] = _machine()
        DOCUMENT.write_text(placed(DOCUMENT.read_text("utf-8"), contents), "utf-8")


if __name__ == "__main__":
    main()
