"""Charts of the last minutes: any quantities of the vehicles and any numbers that agents note, one curve per vehicle."""

import math
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
import viser
from viser import uplot

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.page.controls import picked
from vcmvsp.cosim.view.page.drawing import Every, css_of
from vcmvsp.cosim.view.page.state import PageState
from vcmvsp.cosim.view.page.vehicles import errors_of

POINTS = 300  # of each curve
PERIOD_S = 0.5
CURVES = 7  # limited by the number of colours; of more vehicles, the first ones and the chosen one
WINDOW_NS = 5 * SECOND_NS  # of the delivery ratio
MOST_NOTES = 40  # names of notes that are collected
NOTHING, ALL, CHOSEN = "none", "all vehicles", "the chosen vehicle"
LARGEST_RATIO = 1e4  # of the ends of a logarithmic axis
HEIGHT_PX = 190

DELIVERY = "Received of the last 5 s [%]"
QUANTITIES: Mapping[str, Callable[[PageState], Array]] = {
    "Speed [m/s]": lambda known: known.speed,
    "Formation error [m]": errors_of,
    "Time since the last message [s]": lambda known: known.age_s,
    "Level of the last message [dBm]": lambda known: known.level_dbm,
    "East [m]": lambda known: known.position[:, 0],
    "North [m]": lambda known: known.position[:, 1],
    "Height [m]": lambda known: known.position[:, 2],
    "Heading [rad]": lambda known: known.yaw,
}
"""Quantities of each vehicle, (n,), by their titles; NaN: unknown."""
AT_FIRST = "Speed [m/s]", "Formation error [m]", DELIVERY, "Time since the last message [s]"


class History:
    """The newest `POINTS` instants of all quantities, one value per vehicle.

    Attributes:
        time_s: the instants, s.
        numbers: values at these instants, (n,) each, by title; notes have the title ``note NAME``.
    """

    def __init__(self, scenery: Scenery) -> None:
        self._count = len(scenery.vehicles)
        self._times_back = 0
        self.time_s: deque[float] = deque(maxlen=POINTS)
        self.numbers: dict[str, deque[Array]] = {title: deque(maxlen=POINTS) for title in (*QUANTITIES, DELIVERY)}
        self._counts: deque[tuple[int, Array, Array]] = deque(maxlen=POINTS)

    def sample(self, state: PageState) -> bool:
        """Add the present values; returns whether time has advanced. A step back in time clears the history."""
        if state.times_back != self._times_back:
            self._times_back = state.times_back
            self.time_s.clear()
            self._counts.clear()
            for numbers in self.numbers.values():
                numbers.clear()
        if self.time_s and state.now.time_ns / SECOND_NS <= self.time_s[-1]:
            return False
        now = {title: quantity(state).copy() for title, quantity in QUANTITIES.items()}
        now |= {DELIVERY: self._delivery(state), **self._noted(state)}
        unknown = np.full(self._count, np.nan)
        for title in now.keys() - self.numbers.keys():  # a new note
            self.numbers[title] = deque([unknown] * len(self.time_s), maxlen=POINTS)
        self.time_s.append(state.now.time_ns / SECOND_NS)
        for title, numbers in self.numbers.items():
            numbers.append(now.get(title, unknown))
        return True

    def _noted(self, state: PageState) -> dict[str, Array]:
        """The newest number that each vehicle has noted under each name; NaN without one."""
        numbers: dict[str, Array] = {}
        for vehicle, notes in state.now.notes.items():
            for name, value in notes.items():
                title = f"note {name}"
                full = title not in self.numbers and len(self.numbers) >= len(QUANTITIES) + 1 + MOST_NOTES
                if isinstance(value, float) and vehicle in state.row and not full:
                    numbers.setdefault(title, np.full(self._count, np.nan))[state.row[vehicle]] = value
        return numbers

    def _delivery(self, state: PageState) -> Array:
        """Delivery ratio at each vehicle over the last 5 s, in percent; NaN without frames."""
        if state.now.sent is None or state.now.received is None:
            return np.full(self._count, np.nan)
        sent, received = state.now.sent.sum(axis=0), state.now.received.sum(axis=0)
        while len(self._counts) > 1 and self._counts[1][0] <= state.now.time_ns - WINDOW_NS:
            self._counts.popleft()
        self._counts.append((state.now.time_ns, sent, received))
        _, sent_then, received_then = self._counts[0]
        new = sent - sent_then
        return np.where(new > 0, 100.0 * (received - received_then) / np.maximum(new, 1), np.nan)


class Chart:
    """One chart. A new frame needs a new chart, because a page would keep the old axes."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._gui = server.gui
        self._place = server.gui.add_folder(None)
        self._node: viser.GuiUplotHandle | viser.GuiMarkdownHandle | None = None
        self._frame: tuple[object, ...] = ()

    def draw(self, title: str, time_s: Array, curves: Array, names: list[str], strokes: list[str], *, log: bool) -> None:
        """Draw curves, (k, n), with these names and colours over times, (k,) s; NaN values are omitted.

        Args:
            log: with a logarithmic axis of the values, of which those above 0 are drawn.
        """
        if log:
            curves = np.where(curves > 0.0, curves, np.nan)
        finite = curves[np.isfinite(curves)]
        ends = limits_of(finite, log=log) if len(finite) else None
        if log and ends is not None and (unit := readable_unit(ends[0])) < 1.0:
            title, curves, ends = in_unit(title, unit), curves / unit, (ends[0] / unit, ends[1] / unit)
        frame = title, ends, log, tuple(names), tuple(strokes)
        data = (time_s, *np.ascontiguousarray(curves.T))
        if frame == self._frame:
            if isinstance(self._node, viser.GuiUplotHandle):
                self._node.data = data
            return
        self.clear()
        self._frame = frame
        with self._place:
            if ends is None:
                self._node = self._gui.add_markdown(f"*{title}: no value above 0*" if log else f"*{title}: no value*")
            else:
                # The value axis has explicit limits: the page cannot find the limits of curves that begin with a gap.
                scale: uplot.Scale = {"range": ends, "distr": 3 if log else 1}
                self._node = self._make_plot(title, data, scale, names, strokes)

    def clear(self) -> None:
        """Show nothing."""
        if self._node is not None:
            self._node.remove()
        self._node, self._frame = None, ()

    def _make_plot(
        self, title: str, data: tuple[Array, ...], scale: uplot.Scale, names: list[str], strokes: list[str]
    ) -> viser.GuiUplotHandle:
        curves = (
            uplot.Series(label=name, stroke=stroke, width=1.5, points={"show": False})
            for name, stroke in zip(names, strokes, strict=True)
        )
        return self._gui.add_uplot(
            data=data,
            series=(uplot.Series(label="time [s]"), *curves),
            title=title,
            scales={"x": {"time": False}, "y": scale},
            axes=({"label": "time [s]", "labelSize": 18, "size": 32}, {"size": 54}),
            legend={"show": len(names) > 1},
            height=HEIGHT_PX,
            padding=(8, 24, 0, 0),
        )


class Charts:
    """Charts of chosen quantities, updated at most twice a second. Create them in the context of their container."""

    def __init__(self, server: viser.ViserServer, scenery: Scenery) -> None:
        gui = server.gui
        self._names = [each.name for each in scenery.vehicles]
        self._history = History(scenery)
        self._often = Every(PERIOD_S)
        self._log = gui.add_checkbox("Log scale", initial_value=False)
        self._log.on_update(lambda _: self._redraw())
        self._of = gui.add_dropdown("Curves of", (ALL, CHOSEN))
        self._of.on_update(lambda _: self._redraw())
        self._places: list[tuple[viser.GuiDropdownHandle[str], Chart]] = []
        for number, title in enumerate(AT_FIRST, 1):
            choice = gui.add_dropdown(f"Chart {number}", self._options, initial_value=title)
            choice.on_update(lambda _: self._redraw())
            self._places.append((choice, Chart(server)))
        self._dark, self._new = False, False
        self._rows: list[int] = []

    @property
    def _options(self) -> tuple[str, ...]:
        return NOTHING, *self._history.numbers

    def sample(self, state: PageState, now_s: float) -> None:
        """Add the present values, twice a second."""
        if self._names and self._often.due(now_s):
            self._new |= self._history.sample(state)

    def draw(self, chosen: int) -> None:
        """Draw charts with new data."""
        rows, history = self._shown_rows(chosen), self._history
        if not (self._new or (history.time_s and rows != self._rows)):
            return
        self._rows, self._new = rows, False
        time_s, options = np.array(history.time_s), self._options
        names = [self._names[row] for row in rows]
        strokes = [css_of(row, dark=self._dark) for row in rows]
        left_out = f", {len(rows)} of {len(self._names)} vehicles" if len(rows) < len(self._names) else ""
        for choice, chart in self._places:
            if options != tuple(choice.options):
                choice.options = options
            title = picked(choice)
            if title in history.numbers:
                numbers = np.array(history.numbers[title])
                chart.draw(f"{title}{left_out}", time_s, numbers[:, rows], names, strokes, log=self._log.value)
            else:
                chart.clear()

    def _redraw(self) -> None:
        self._new = bool(self._history.time_s)

    def darken(self, dark: bool) -> None:
        """Set the colours for a light or a dark page."""
        self._dark = dark
        self._redraw()

    def _shown_rows(self, chosen: int) -> list[int]:
        if picked(self._of) == CHOSEN:
            return [chosen][: len(self._names)]
        if len(self._names) <= CURVES:
            return list(range(len(self._names)))
        return [*range(CURVES)] if chosen < CURVES else [*range(CURVES - 1), chosen]


def limits_of(values: Array, *, log: bool) -> tuple[float, float]:
    """Limits of an axis for these values, which seldom change: round numbers, and 0 unless all values are far from it."""
    low, high = float(values.min()), float(values.max())
    if log:
        low = max(low, high / LARGEST_RATIO)
        return 10.0 ** math.floor(math.log10(low)), 10.0 ** math.ceil(math.log10(high) + 1e-9)
    nearest, furthest = sorted((abs(low), abs(high)))
    if low * high > 0.0 and nearest > 0.5 * furthest and high - low > 0.01 * furthest:
        step = round_above(high - low)
        return math.floor(low / step) * step, math.ceil(high / step) * step
    bottom = -round_above(-low) if low < 0.0 else 0.0
    top = round_above(high) if high > 0.0 or low == 0.0 else 0.0
    return bottom, top


def readable_unit(low: float) -> float:
    """The largest of 1, 0.001, ... in which a page, which writes three decimals, can write this value above 0."""
    return 1000.0 ** min(0, math.floor((math.log10(low) + 1e-9) / 3.0) + 1)


def in_unit(title: str, unit: float) -> str:
    """The title of a chart with another unit: ``Height [m]`` becomes ``Height [0.001 m]``."""
    name, bracket, rest = title.partition(" [")
    return f"{name} [{unit:g} {rest}" if bracket else f"{name} [{unit:g}]"


def round_above(number: float) -> float:
    """The least of 1, 2, 5, 10, ... not below a number: an axis limit that seldom changes."""
    number = max(number, 0.01)
    power = 10.0 ** math.floor(math.log10(number))
    return next(step * power for step in (1.0, 2.0, 5.0, 10.0) if step * power >= number * (1.0 - 1e-9))
