"""Charts of the last minutes: speeds, formation errors, deliveries, ages and a note of each vehicle."""

import math
from collections import deque

import numpy as np
import viser
from viser import uplot

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.drawing import Every, css_of
from vcmvsp.cosim.view.page.state import Known
from vcmvsp.cosim.view.page.vehicles import errors_of

POINTS = 300  # of each curve
PERIOD_S = 0.5
CURVES = 7  # limited by the number of colours; of more vehicles, the first ones and the chosen one
WINDOW_NS = 5 * SECOND_NS  # of the delivery ratio
TITLES = "Speed [m/s]", "Formation error [m]", "Received of the last 5 s [%]", "Time since the last message [s]", "Note"
NOTHING = "none"
LARGEST_RATIO = 1e4  # of the ends of an axis with decades
HEIGHT_PX = 190


class History:
    """Data of the charts: one row per vehicle and quantity, the newest `POINTS` instants."""

    def __init__(self, scenery: Scenery) -> None:
        self._count = len(scenery.vehicles)
        self._times_back = 0
        self.note = NOTHING  # name of the notes in the last row of `numbers`
        self.known_notes: set[str] = set()
        self.time_s: deque[float] = deque(maxlen=POINTS)
        self.numbers: list[deque[Array]] = [deque(maxlen=POINTS) for _ in TITLES]
        self._counts: deque[tuple[int, Array, Array]] = deque(maxlen=POINTS)

    def sample(self, known: Known) -> bool:
        """Add the present values; returns whether time has advanced. A step back in time clears the history."""
        if known.times_back != self._times_back:
            self._times_back = known.times_back
            self.time_s.clear()
            self._counts.clear()
            for numbers in self.numbers:
                numbers.clear()
        if self.time_s and known.now.time_ns / SECOND_NS <= self.time_s[-1]:
            return False
        self.time_s.append(known.now.time_ns / SECOND_NS)
        quantities = (known.speed, errors_of(known), self._delivery(known), known.age_s, self._noted(known))
        for numbers, each in zip(self.numbers, quantities, strict=True):
            numbers.append(each)
        return True

    def choose(self, note: str) -> None:
        """Collect another note from now on."""
        self.note = note
        self.numbers[-1] = deque([np.full(self._count, np.nan)] * len(self.time_s), maxlen=POINTS)

    def _noted(self, known: Known) -> Array:
        """The newest number that each vehicle has noted under the chosen name; NaN without one."""
        found = np.full(self._count, np.nan)
        for vehicle, notes in known.now.notes.items():
            self.known_notes.update(name for name, value in notes.items() if isinstance(value, float))
            value = notes.get(self.note)
            if isinstance(value, float) and vehicle in known.row:
                found[known.row[vehicle]] = value
        return found

    def _delivery(self, known: Known) -> Array:
        """Delivery ratio at each vehicle over the last 5 s, in percent; NaN without frames."""
        if known.now.sent is None or known.now.received is None:
            return np.full(self._count, np.nan)
        sent, received = known.now.sent.sum(axis=0), known.now.received.sum(axis=0)
        while len(self._counts) > 1 and self._counts[1][0] <= known.now.time_ns - WINDOW_NS:
            self._counts.popleft()
        self._counts.append((known.now.time_ns, sent, received))
        _, sent_then, received_then = self._counts[0]
        new = sent - sent_then
        return np.where(new > 0, 100.0 * (received - received_then) / np.maximum(new, 1), np.nan)


class Chart:
    """One chart. A new frame needs a new chart, because a page would keep the old axes."""

    def __init__(self, server: viser.ViserServer, title: str) -> None:
        self._gui, self.title = server.gui, title
        self._place = server.gui.add_folder(None)
        self._node: viser.GuiUplotHandle | None = None
        self._frame: tuple[object, ...] = ()

    def draw(self, time_s: Array, curves: Array, names: list[str], strokes: list[str], *, log: bool) -> None:
        """Draw curves, (k, n), with these names and colours over times, (k,) s; NaN values are omitted.

        Args:
            log: with decades of the values, of which those above 0 are drawn.
        """
        if log:
            curves = np.where(curves > 0.0, curves, np.nan)
        seen = curves[np.isfinite(curves)]
        ends = limits_of(seen, log=log) if len(seen) else None
        frame = self.title, ends, log, tuple(names), tuple(strokes)
        data = (time_s, *np.ascontiguousarray(curves.T))
        if frame == self._frame and self._node is not None:
            self._node.data = data
            return
        if self._node is not None:
            self._node.remove()
            self._node = None
        self._frame = frame
        if ends is not None:
            # The value axis has explicit limits: the page cannot find the limits of curves that begin with a gap.
            scale: uplot.Scale = {"range": ends, "distr": 3 if log else 1}
            with self._place:
                self._node = self._made(data, scale, names, strokes)

    def _made(self, data: tuple[Array, ...], scale: uplot.Scale, names: list[str], strokes: list[str]) -> viser.GuiUplotHandle:
        curves = (
            uplot.Series(label=name, stroke=stroke, width=1.5, points={"show": False})
            for name, stroke in zip(names, strokes, strict=True)
        )
        return self._gui.add_uplot(
            data=data,
            series=(uplot.Series(label="time [s]"), *curves),
            title=self.title,
            scales={"x": {"time": False}, "y": scale},
            axes=({"label": "time [s]", "labelSize": 18, "size": 32}, {"size": 44}),
            legend={"show": len(names) > 1},
            height=HEIGHT_PX,
            padding=(8, 24, 0, 0),
        )


class Charts:
    """Charts of all quantities, updated at most twice a second. Create them in the context of their container."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        self._names = [each.name for each in scenery.vehicles]
        self._history = History(scenery)
        self._often = Every(PERIOD_S)
        self._log = server.gui.add_checkbox("Decades", initial_value=False)
        self._note = server.gui.add_dropdown("Note", [NOTHING], initial_value=NOTHING)
        self._note.on_update(lambda _: self._choose())
        self._log.on_update(lambda _: self._redraw())
        self._of = f", {CURVES} of {len(self._names)} vehicles" if len(self._names) > CURVES else ""
        self._charts = [Chart(server, title + self._of) for title in TITLES]
        self._dark, self._new = False, False
        self._rows: list[int] = []

    def sample(self, known: Known, now_s: float) -> None:
        """Add the present values, twice a second."""
        if self._names and self._often.due(now_s):
            self._new |= self._history.sample(known)

    def draw(self, chosen: int) -> None:
        """Draw charts with new data."""
        rows = self._shown_rows(chosen)
        options = (NOTHING, *sorted(self._history.known_notes))
        if options != tuple(self._note.options):
            self._note.options = options
        if not (self._new or (self._history.time_s and rows != self._rows)):
            return
        self._rows, self._new = rows, False
        time_s = np.array(self._history.time_s)
        names, strokes = [self._names[row] for row in rows], [css_of(row, dark=self._dark) for row in rows]
        for chart, numbers in zip(self._charts, self._history.numbers, strict=True):
            chart.draw(time_s, np.array(numbers)[:, rows], names, strokes, log=self._log.value)

    def _choose(self) -> None:
        name = self._note.value
        self._history.choose(name)
        self._charts[-1].title = f"Note: {name}{self._of}"
        self._redraw()

    def _redraw(self) -> None:
        self._new = bool(self._history.time_s)

    def darken(self, dark: bool) -> None:
        """Set the colours for a light or a dark page."""
        self._dark, self._new = dark, bool(self._history.time_s)

    def _shown_rows(self, chosen: int) -> list[int]:
        if len(self._names) <= CURVES:
            return list(range(len(self._names)))
        return [*range(CURVES)] if chosen < CURVES else [*range(CURVES - 1), chosen]


def limits_of(values: Array, *, log: bool) -> tuple[float, float]:
    """Limits of an axis for these values: whole decades, or 0, or what is below it, and a round number; they seldom change."""
    low, high = float(values.min()), float(values.max())
    if log:
        low = max(low, high / LARGEST_RATIO)
        return 10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high) + 1e-9)
    return -round_above(-low) if low < 0.0 else 0.0, round_above(high)


def round_above(number: float) -> float:
    """The least of 1, 2, 5, 10, ... not below a number: an axis limit that seldom changes."""
    number = max(number, 0.01)
    power = 10.0 ** math.floor(math.log10(number))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= number * (1.0 - 1e-9))
