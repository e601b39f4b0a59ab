"""CPU time of whole runs by part: Bullet, the rest of physics, radio, agents, kernel, recording, start and end.

``python -m bench.shares [FOLDER]`` prints the table and leaves shares.csv, .png and .svg in the folder. Each run is a process
of its own, from the interpreter's start to the last file, as by ``vcmvsp run``, or as in a study. Calls are timed from
outside; the cost of the clock itself is measured first and subtracted.
"""

import csv
import functools
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from bench.measure import Row, table
from vcmvsp.cosim.kernel.kernel import Kernel, Observer
from vcmvsp.cosim.runs import api

FOLDER = Path("runs") / "shares"
PARTS = ("Bullet", "physics", "radio", "agents", "kernel", "recording", "start", "end")
PACKAGES = {"physics": "physics", "netsim": "radio", "agents": "agents"}  # of federates; those of the core are the kernel's
CALLS = 20_000  # that measure the cost of the clock


class Case(NamedTuple):
    """A built-in scenario, with a few keys changed."""

    description: str
    settings: Mapping[str, Any] = {}
    study: bool = False  # tables and metrics alone


CASES = {
    "formation-circle": Case("3 robots"),
    "mixed-50": Case("25 robots, 25 quadrotors, sensors", {"duration_s": 15.0}),
    "swarm-100": Case("100 quadrotors"),
    "study-size": Case("50 kinematic vehicles, 802.11b, as in its study", {"vehicle.car.count": 49}, study=True),
}


class Stopwatch:
    """CPU time of this process by part: calls from one part into another count for the latter alone."""

    def __init__(self) -> None:
        self._spent = dict.fromkeys((*PARTS, "outside", "inside"), 0.0)
        self._calls: Counter[tuple[str, str]] = Counter()  # by caller and callee
        self._now, self._since = "start", 0.0  # the process's clock began with it
        self._outside_s, self._inside_s = self._own()

    def change(self, part: str) -> str:
        """Count time for this part from here on; returns the part before."""
        before, now = self._now, time.process_time()
        self._spent[before] += now - self._since
        self._now, self._since = part, now
        return before

    def clocked(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, whose time counts for this part."""
        calls, change = self._calls, self.change

        def clocked(*args: Any, **named: Any) -> Any:
            before = change(part)
            try:
                return function(*args, **named)
            finally:
                change(before)
                calls[before, part] += 1

        return clocked

    def spent(self) -> dict[str, float]:
        """CPU seconds by part, without the cost of the clock."""
        self.change(self._now)
        found = {part: self._spent[part] for part in PARTS}
        for (caller, called), count in self._calls.items():
            found[caller] -= count * self._outside_s
            found[called] -= count * self._inside_s
        return {part: max(0.0, seconds) for part, seconds in found.items()}

    def _own(self) -> tuple[float, float]:
        """CPU seconds that a timed call adds to the call, to its caller's time and to its own."""

        def nothing() -> None:
            """No work."""

        bare = time.process_time()
        for _ in range(CALLS):
            nothing()
        bare = (time.process_time() - bare) / CALLS
        clocked, before = self.clocked("inside", nothing), self.change("outside")
        for _ in range(CALLS):
            clocked()
        self.change(before)
        self._calls.clear()
        outside, inside = self._spent["outside"] / CALLS, self._spent["inside"] / CALLS
        return outside, max(0.0, inside - bare)


def spent(name: str) -> dict[str, float]:
    """CPU seconds by part of a run in this process, which has done nothing else yet."""
    case, watch, begin, advance = CASES[name], Stopwatch(), Kernel.begin, Kernel.advance

    def clocked(kernel: Kernel, observe: Observer) -> None:
        for federate in kernel._federates:
            part = PACKAGES.get(type(federate).__module__.removeprefix("vcmvsp.").partition(".")[0])
            if part is not None:
                federate.step = watch.clocked(part, federate.step)  # type: ignore[method-assign]
        bullet: Any = sys.modules.get("pybullet")
        if bullet is not None:
            bullet.stepSimulation = watch.clocked("Bullet", bullet.stepSimulation)
        watch.change("kernel")
        begin(kernel, watch.clocked("recording", observe))

    def last(kernel: Kernel, on_instant: Any = None) -> bool:
        goes_on = advance(kernel, on_instant)
        watch.change("end")
        return goes_on

    Kernel.begin, Kernel.advance = clocked, last  # type: ignore[method-assign, assignment]  # of this process alone
    with tempfile.TemporaryDirectory() as folder:
        out = None if case.study else Path(folder) / "run"
        api.run(name, set=case.settings, agents="inprocess", mcap=not case.study, out=out)
        return watch.spent()


@functools.cache
def measured() -> Mapping[str, Mapping[str, float]]:
    """CPU seconds by part of every case, with progress."""
    found = {}
    for name in CASES:
        print(f"measuring: shares, {name} ...", file=sys.stderr, flush=True)
        command = [sys.executable, "-m", "bench.shares", "--one", name]
        found[name] = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
    return found


def rows() -> list[Row]:
    """A row for each run; the picture is drawn, too."""
    found = measured()
    print("\n".join(map(str, write(found, FOLDER))), file=sys.stderr)
    return [_row(name, seconds) for name, seconds in found.items()]


def _row(name: str, seconds: Mapping[str, float]) -> Row:
    whole = sum(seconds.values())
    shares = ", ".join(f"{part} {100 * seconds[part] / whole:.0f} %" for part in PARTS if seconds[part] >= 0.005 * whole)
    title = f"`{name}`, {CASES[name].description}: where CPU time goes; beside the whole (ratio: Bullet's share)"
    return Row(title, shares, f"{whole:.1f} CPU s", seconds["Bullet"] / whole, "none", True)


def write(found: Mapping[str, Mapping[str, float]], folder: Path) -> list[Path]:
    """Write the CPU seconds as shares.csv, and draw them; returns the files."""
    from vcmvsp.cosim.plots import style

    folder.mkdir(parents=True, exist_ok=True)
    numbers = folder / "shares.csv"
    with numbers.open("w", encoding="utf-8", newline="") as file:
        lines = csv.writer(file, lineterminator="\n")
        lines.writerow(("scenario", *(f"{part}_s" for part in PARTS)))
        for name, seconds in found.items():
            lines.writerow((name, *(f"{seconds[part]:.4f}" for part in PARTS)))
    return [numbers, *style.save(draw(found), folder / "shares")]


def draw(found: Mapping[str, Mapping[str, float]]) -> Any:
    """Draw a bar for each run, as long as all others, of its parts."""
    from matplotlib.figure import Figure

    from vcmvsp.cosim.plots.style import ABOVE, GREY, styled
    from vcmvsp.cosim.util.palette import OKABE_ITO

    colors = (*OKABE_ITO[1:], "0.8", GREY)  # black would hide its label

    @styled
    def drawn() -> Figure:
        figure = Figure(figsize=(7.0, 1.1 + 0.55 * len(found)), layout="constrained")
        axes = figure.add_subplot()
        figure.suptitle("Where the CPU time of a run goes")
        left = dict.fromkeys(found, 0.0)
        for part, color in zip(PARTS, colors, strict=True):
            for place, (name, seconds) in enumerate(found.items()):
                share = 100.0 * seconds[part] / sum(seconds.values())
                label = part if place == 0 else None
                axes.barh(place, share, left=left[name], height=0.7, color=color, edgecolor="white", linewidth=0.8, label=label)
                if share >= 3.5:
                    ink = "white" if part == "Bullet" else "black"
                    axes.text(left[name] + 0.5 * share, place, f"{share:.0f}", ha="center", va="center", color=ink, fontsize=8)
                left[name] += share
        names = [f"{name}\n{sum(seconds.values()):.1f} CPU s" for name, seconds in found.items()]
        axes.set_yticks(range(len(found)), names)
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set_xlim(0.0, 100.0)
        axes.set_xlabel("share of CPU time, from the start of the interpreter to the last file [%]")
        axes.legend(ncols=len(PARTS), **{**ABOVE, "columnspacing": 0.9, "handlelength": 1.2, "handletextpad": 0.4})
        return figure

    return drawn()


def main(arguments: Sequence[str]) -> None:
    """Print the table and draw it; or, with ``--one NAME``, the CPU seconds of one run as JSON."""
    if arguments[:1] == ["--one"]:
        print(json.dumps(spent(arguments[1])))
        return
    found = measured()
    print(table([_row(name, seconds) for name, seconds in found.items()]))
    print("\n".join(map(str, write(found, Path(*arguments) if arguments else FOLDER))))


if __name__ == "__main__":
    main(sys.argv[1:])
