"""Progress display of runs and studies (a bar on a terminal, periodic lines in a log), and the summary of a finished run."""

import contextlib
import os
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Self

from vcmvsp.cosim.clock import SECOND_NS

if TYPE_CHECKING:
    from rich.live import Live
    from rich.progress import Progress as RichProgress

    from vcmvsp.cosim.federate import Event
    from vcmvsp.cosim.runs.api import Result
    from vcmvsp.cosim.terminal.live_table import LiveTable, TableLine

LOG_EVERY_S = 5.0
SHAPE_M = 0.05  # a misfit that is worth a word even where no follower is followed
DRAW_EVERY_S = 0.25
SHARE = 100.0  # drawing takes at most 1 / SHARE of the time
MIN_BAR = 8  # columns
STYLES = {"head": "bold", "bad": "red", "halted": "yellow", "more": "dim"}


class StatusDisplay:
    """Progress display of a long task on stderr, drawn rarely.

    Args:
        quiet: show nothing.
    """

    _bar: "RichProgress"  # created with the screen

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._screen: Live | None = None
        # A terminal with cursor control can be redrawn; all other outputs are written like a log file.
        self._terminal = not quiet and sys.stderr.isatty() and os.environ.get("TERM", "") not in ("", "dumb", "unknown")
        self._every_s = DRAW_EVERY_S if self._terminal else LOG_EVERY_S
        self._last = time.monotonic()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._screen is not None:
            with contextlib.suppress(OSError):
                self._screen.stop()

    def tell(self, text: str) -> None:
        """Show a line of text."""
        if not self._quiet:
            sys.stderr.write(f"{text}\n")
            sys.stderr.flush()

    def _is_due(self) -> bool:
        now = time.monotonic()
        if self._quiet or now - self._last < self._every_s:
            return False
        self._last = now
        return True

    def show(self, words: str, done: float, total: float) -> None:
        """Show words on the progress, if due."""
        if self._is_due():
            self._draw(done, total, words) if self._terminal else self.tell(words)

    def _draw(self, completed: float, total: float, words: str) -> None:
        try:
            screen = self._open_screen() if self._screen is None else self._screen
            begin = time.monotonic()
            self._draw_on(screen, completed, total, words)
            self._every_s = min(max(DRAW_EVERY_S, SHARE * (time.monotonic() - begin)), LOG_EVERY_S)
        except OSError:  # the terminal was closed; the task continues without it
            self._quiet = True

    def _draw_on(self, screen: "Live", completed: float, total: float, words: str) -> None:
        from rich.console import Group
        from rich.text import Text

        width, height = screen.console.size
        self._bar.update(self._bar.task_ids[0], completed=completed, total=total, description=words[: width - MIN_BAR])
        below = [
            Text(each.text, STYLES.get(each.kind, ""), no_wrap=True, overflow="crop") for each in self._below(width, height - 2)
        ]
        screen.update(Group(self._bar.get_renderable(), *below), refresh=True)

    def _below(self, width: int, height: int) -> "Sequence[TableLine]":
        """Lines below the bar, at most ``width`` by ``height`` characters."""
        return ()

    def _open_screen(self) -> "Live":
        from rich.console import Console
        from rich.live import Live
        from rich.progress import BarColumn, Progress, TextColumn

        console = Console(stderr=True, color_system=None if os.environ.get("NO_COLOR") else "auto", highlight=False)
        columns = BarColumn(None, complete_style="cyan", finished_style="green"), TextColumn("{task.description}", markup=False)
        self._bar = Progress(*columns, console=console, auto_refresh=False, expand=True)
        self._bar.add_task("")
        self._screen = Live(console=console, auto_refresh=False, transient=True, vertical_overflow="crop")
        self._screen.start()
        return self._screen


class Progress(StatusDisplay):
    """Progress of a run and, on a terminal, a table of its vehicles. Reads the wall clock once an instant."""

    _table: "LiveTable | None" = None
    _begin: float | None = None
    _now_ns = 0

    def observer(self, kinds: Mapping[str, str]) -> "Callable[[Event], None] | None":
        """Observer of the run's events for the vehicle table, with the agents' kinds by vehicle; None if it is not shown."""
        if not self._terminal:
            return None
        from vcmvsp.cosim.terminal.live_table import LiveTable

        self._table = LiveTable(kinds)
        return self._table.on

    def on_instant(self, now_ns: int, end_ns: int) -> None:
        """Update the progress of the run."""
        if self._begin is None:
            self._begin = time.monotonic()
        over = now_ns >= end_ns and self._screen is not None  # the files are written then, which also takes time
        if not self._is_due() and not over:
            return
        self._now_ns = now_ns
        taken_s = max(time.monotonic() - self._begin, 1e-9)
        speed = now_ns / SECOND_NS / taken_s
        remaining = f", {clock(taken_s * (end_ns - now_ns) / now_ns)} left" if now_ns else ""
        how_far, pace = f"{now_ns / SECOND_NS:.1f} of {end_ns / SECOND_NS:g} s", _times(speed)
        if self._terminal:
            self._draw(now_ns, end_ns, f"{how_far}, {pace}{', writing' if over else remaining}")
        else:
            self.tell(f"{how_far} simulated ({100 * now_ns // end_ns} %, {pace} real time)")

    def _below(self, width: int, height: int) -> "Sequence[TableLine]":
        return () if self._table is None else self._table.lines(self._now_ns, width, height)


class StudyProgress(StatusDisplay):
    """Progress of a study, with the current bounds of its first metric.

    Args:
        quiet: show nothing.
        what: name of the units that are counted.
    """

    def __init__(self, *, quiet: bool, what: str = "runs") -> None:
        super().__init__(quiet=quiet)
        self._noun = what

    _first: int | None = None  # number of runs done before this one started
    _begin = 0.0
    _bounds: tuple[str, float, float] | None = None  # of the first metric

    def on_check(self, done: int, total: int) -> None:
        """Update the number of points checked before the first run."""
        self.show(f"checking: {done} of {total} points", done, total)

    def on_value(self, name: str, value: float) -> None:
        """Record the value of a metric in a run."""
        _, least, most = self._bounds or (name, value, value)
        self._bounds = name, min(least, value), max(most, value)

    def on_run(self, done: int, failed: int, total: int) -> None:
        """Update the number of finished runs; the first call, with the runs finished earlier, starts the clock."""
        now = time.monotonic()
        if self._first is None or done <= self._first:
            self._begin, self._first = now, done
        words = f"{done} of {total} {self._noun} done" + (f", {failed} failed" if failed else "")
        if done > self._first:  # estimate of the time left: as long per run as so far
            words += f", {clock((now - self._begin) / (done - self._first) * (total - done))} left"
        if self._bounds is not None:
            name, least, most = self._bounds
            words += f", {name} {least:.3g} to {most:.3g}"
        self.show(words, done, total)


def _times(speed: float) -> str:
    return f"{speed:.{1 if speed < 10.0 else 0}f}x"


def clock(seconds: float) -> str:
    """A duration as text: ``40 s``, ``3 min 20 s``, ``2 h 5 min``."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def summary(result: "Result") -> str:
    """Summary of a finished run as a few lines, with titles in a column of their own."""
    metrics, about = result.metrics, result.about
    places = ", ".join(sorted(set(about["agents"].values())))
    agents = f"{len(about['agents'])} agents" + (f" ({places})" if places else "")
    simulated = f"{metrics['duration_s']:g} s simulated in {about['simulating_s']:.1f} s"
    speed = metrics["duration_s"] / max(about["simulating_s"], 1e-9)
    texts = {f"{label}:": words for label, words in _parts(result) if words}
    width = max(10, *map(len, texts))
    head = f"{metrics['scenario']}: {agents}, {simulated} ({_times(speed)} real time)"
    lines = [f"{label:<{width}} {words}" for label, words in texts.items()]
    return "\n".join([head, *lines, ""])


def _parts(result: "Result") -> Iterator[tuple[str, str]]:
    """Titles and texts of the summary; some texts may be empty."""
    metrics, about = result.metrics, result.about
    yield "radio", _of_radio(metrics["radio"])
    if routing := metrics.get("routing"):
        yield "routing", _of_routing(routing)
    yield "formation", _of_formation(metrics["formation"]) or _unmeasured(result)
    if mission := metrics.get("mission"):
        yield "mission", _of_mission(mission)
    yield "own", ", ".join(f"{name} {_short(value)}" for name, value in metrics.get("own", {}).items())
    for name, real in metrics.get("hardware", {}).items():
        yield name, _of_real(real)
    if late := about["lateness"]:
        yield "lateness", lateness(late)
    if carried := about.get("bridge"):
        yield "bridge", _of_bridge(carried)
    if collisions := metrics["safety"]["collisions"]:
        yield "safety", f"{collisions} collisions"
    lost_s = {name: each["lost_s"] for name, each in metrics["agents"].items()}
    yield "lost", ", ".join(f"{name} for {seconds:.1f} s" for name, seconds in lost_s.items() if seconds)
    yield "results", str(result.folder)


def lateness(late: Mapping[str, Any]) -> str:
    """Text on the lateness of a run relative to the wall clock."""
    words = (
        f"{1000 * late['p50_s']:.2f} ms median, {1000 * late['max_s']:.2f} ms at most, "
        f"{late['over_one_period']} of {late['instants']} ticks late by more than a period"
    )
    return words + (f"; the run slipped by {late['slipped_s']:.3f} s" if late["slipped_s"] else "")


def _of_bridge(carried: Mapping[str, Any]) -> str:
    words = f"{carried['datagrams']} datagrams, {carried['delivered']} deliveries"
    if carried["delivered"]:
        late = f"late by {1000 * carried['p50_s']:.2f} ms median, {1000 * carried['p99_s']:.2f} ms p99"
        words += f", {late}, {carried['over_1ms']} by more than 1 ms"
    refused = (f"{number} {cause} ({name})" for name, counts in carried["counts"].items() for cause, number in counts.items())
    return "; ".join((words, *refused))


def _of_radio(radio: Mapping[str, Any]) -> str:
    if not radio["frames"]:
        return ""
    lost = ", ".join(f"{count} {cause}" for cause, count in radio["losses"].items()) or "none lost"
    lost += f", {radio['under_way']} under way" if radio["under_way"] else ""
    age_s = radio["age_s"]["mean"]
    ratio = radio["delivery_ratio"]
    arrived = "all still under way" if ratio is None else f"{100 * ratio:.1f} % delivered ({lost})"
    words = f"{radio['frames']} frames, {arrived}"
    return words + ("" if age_s is None else f", age {1000 * age_s:.0f} ms")


def _of_routing(routing: Mapping[str, Any]) -> str:
    if not routing["messages"]:
        return ""
    words, ratio = f"{routing['messages']} messages", routing["delivery_ratio"]
    words += "" if ratio is None else f", {100 * ratio:.1f} % delivered"
    if routing["arrivals"]:
        words += f" over {routing['hops_mean']:.1f} hops ({routing['hops_max']} at most)"
    words += f", {routing['forwarded']} frames passed on"
    words += f", {routing['no_route']} without a route" if routing["no_route"] else ""
    return words + (f", {routing['control_frames']} frames about routes" if routing["control_frames"] else "")


def _of_formation(formation: Mapping[str, Any]) -> str:
    if formation["rms_m"] is None:
        return ""
    settled = "not settled" if formation["settling_s"] is None else f"settled after {formation['settling_s']:.1f} s"
    shape_m, chain = formation["shape"]["rms_m"], formation["hop_gain"] is not None  # the errors of links add up
    shape = f", shape {shape_m:.4f} m off a rigid one" if chain or shape_m > max(SHAPE_M, 2.0 * formation["rms_m"]) else ""
    return f"error {formation['rms_m']:.4f} m RMS, {formation['max_m']:.4f} m at most{shape}, {settled}"


def _unmeasured(result: "Result") -> str:
    """Why there is no formation error although vehicles follow others; empty if they do not."""
    (from_s, _), end_s = result.window_s, result.metrics["duration_s"]
    return f"no error: metrics.from_s = {from_s:g} s, the run ended at {end_s:g} s" if result.follows else ""


def _short(value: float | None) -> str:
    return "has no value" if value is None else f"{value:.4g}"


def _of_mission(mission: Mapping[str, Any]) -> str:
    times = mission["found_s"]
    finds = ", ".join(f"{name} {_when(time_s)}" for name, time_s in times.items())
    words = f"{mission['targets_found']} of {len(times)} targets found ({finds}), {mission['targets_tracked']} tracked"
    area = mission["area_seen_ratio"]
    return words + ("" if area is None else f", {100 * area:.0f} % of the area seen")


def _when(time_s: float | None) -> str:
    return "never" if time_s is None else f"{time_s:.1f} s"


def _of_real(real: Mapping[str, Any]) -> str:
    age_s, fixes = real["age_s"]["p50"], real["fixes"]
    words = [f"real, {1000 * age_s:.0f} ms old" if age_s is not None else "real, no message received"]
    if fixes:
        words.append(f"{fixes} positions ({real['gated']} rejected)")
    if real["limited_s"]:
        from vcmvsp.cosim.recording.event_text import of_limits  # here, because it loads NumPy

        words.append(f"limited for {real['limited_s']:.1f} s ({of_limits(real['limited_by_s'])})")
    words += [f"stopped {count} x: {cause}" for cause, count in real["stops"].items()]
    if real["frames_too_early"]:
        words.append(f"{real['frames_too_early']} frames were received after less than that, faster than any real link")
    return ", ".join(words)
