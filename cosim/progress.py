"""What a run shows while it goes on, and in the end: a bar on a terminal, a line every few seconds in a log."""

import sys
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

if TYPE_CHECKING:
    from cosim.api import Result

LOG_EVERY_S = 5.0
DRAW_EVERY_S = 0.1


class Shown:
    """Something that takes its time, on stderr; drawing is rare.

    Args:
        quiet: show nothing.
    """

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._bar: Any = None
        self._task: Any = None
        self._terminal = sys.stderr.isatty() and not quiet
        self._every_s = DRAW_EVERY_S if self._terminal else LOG_EVERY_S
        self._start = self._last = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()

    def tell(self, text: str) -> None:
        """Show a line."""
        if not self._quiet:
            sys.stderr.write(f"{text}\n")
            sys.stderr.flush()

    def _is_due(self) -> bool:
        """Whether it is time to show how far it is."""
        now = time.monotonic()
        if self._quiet or now - self._last < self._every_s:
            return False
        self._last = now
        return True

    def _draw(self, completed: float, total: float, words: str = "") -> None:
        """Show the bar, on a terminal."""
        if self._bar is None:
            from rich.console import Console
            from rich.progress import Progress as Bar

            self._bar = Bar(*self._columns(), console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("")
            self._bar.start()
        self._bar.update(self._task, completed=completed, total=total, description=words)

    def _columns(self) -> Sequence[Any]:
        """What the bar consists of."""
        from rich.progress import BarColumn, TextColumn

        return BarColumn(), TextColumn("{task.description}")


class Progress(Shown):
    """How far a run is. The clock is looked at once an instant."""

    def on_instant(self, now_ns: int, end_ns: int) -> None:
        """Note how far the run is."""
        if not self._is_due():
            return
        if self._terminal:
            self._draw(now_ns / 1e9, end_ns / 1e9)
        else:
            speed = now_ns / 1e9 / max(self._last - self._start, 1e-9)
            self.tell(
                f"{now_ns / 1e9:.1f} of {end_ns / 1e9:g} s simulated ({100 * now_ns // end_ns} %, {speed:.1f}x real time)"
            )

    def _columns(self) -> Sequence[Any]:
        from rich.progress import BarColumn, TextColumn, TimeRemainingColumn

        how_far = TextColumn("{task.completed:.1f} of {task.total:g} s")
        return TextColumn("simulating"), BarColumn(), how_far, TimeRemainingColumn()


def summary(result: "Result") -> str:
    """A finished run in a few lines."""
    metrics, about = result.metrics, result.about
    formation, radio = metrics["formation"], metrics["radio"]
    places = ", ".join(sorted(set(about["agents"].values())))
    agents = f"{len(about['agents'])} agents" + (f" ({places})" if places else "")
    speed = metrics["duration_s"] / max(about["simulating_s"], 1e-9)
    lines = [
        f"{metrics['scenario']}: {agents}, {metrics['duration_s']:g} s simulated in {about['simulating_s']:.1f} s "
        f"({speed:.0f}x real time)"
    ]
    if radio["frames"]:
        lost = ", ".join(f"{count} {cause}" for cause, count in radio["losses"].items()) or "none lost"
        lines.append(
            f"radio:     {radio['frames']} frames, {100 * radio['delivery_ratio']:.1f} % delivered ({lost})"
            + (f", age {1000 * radio['age_s']['mean']:.0f} ms" if radio["age_s"]["mean"] is not None else "")
        )
    if formation["rms_m"] is not None:
        settled = "not settled" if formation["settling_s"] is None else f"settled after {formation['settling_s']:.1f} s"
        chain = formation["hop_gain"] is not None  # errors of links add up
        shape = f", shape {formation['shape']['rms_m']:.4f} m" if chain else ""
        lines.append(f"formation: error {formation['rms_m']:.4f} m RMS, {formation['max_m']:.4f} m at most{shape}, {settled}")
    if mission := metrics.get("mission"):
        lines.append(f"mission:   {_of_mission(mission)}")
    for name, real in metrics.get("hardware", {}).items():
        lines.append(f"{name + ':':<10} {_of_real(real)}")
    if late := about["lateness"]:
        lines.append(f"lateness:  {lateness(late)}")
    lines.append(f"results:   {result.folder}")
    return "\n".join(lines) + "\n"


def lateness(late: Mapping[str, Any]) -> str:
    """How late a run was on the wall clock."""
    words = (
        f"{1000 * late['p50_s']:.2f} ms median, {1000 * late['max_s']:.2f} ms at most, "
        f"{late['over_one_period']} of {late['instants']} ticks late by more than a period"
    )
    return words + (f"; the run slipped by {late['slipped_s']:.3f} s" if late["slipped_s"] else "")


def _of_mission(mission: Mapping[str, Any]) -> str:
    """What was found, and when."""
    times = mission["found_s"]
    found = ", ".join(f"{name} {'never' if time_s is None else f'{time_s:.1f} s'}" for name, time_s in times.items())
    words = f"{mission['targets_found']} of {len(times)} targets found ({found}), {mission['targets_tracked']} tracked"
    seen = mission["area_seen_ratio"]
    return words + ("" if seen is None else f", {100 * seen:.0f} % of the area seen")


def _of_real(real: Mapping[str, Any]) -> str:
    """How a real vehicle was known and driven, in a line."""
    age_s, fixes = real["age_s"]["p50"], real["fixes"]
    words = [f"real, {1000 * age_s:.0f} ms old" if age_s is not None else "real, never heard"]
    if fixes:
        words.append(f"{fixes} positions ({real['gated']} did not fit)")
    if real["limited_s"]:
        words.append(f"held back for {real['limited_s']:.1f} s")
    words += [f"stopped {count} x: {cause}" for cause, count in real["stops"].items()]
    if real["frames_too_early"]:
        words.append(f"{real['frames_too_early']} frames were received after less than that: no real link is so quick")
    return ", ".join(words)
