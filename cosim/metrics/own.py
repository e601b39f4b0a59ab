"""Own metrics of a scenario (``[metrics.own]``): functions of a run's result, or statistics of notes.

A metric is called with the `vcmvsp.Result` of the run, whose tables are whole and whose ``metrics`` hold all other numbers.
"""

import functools
import inspect
import math
import traceback
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from vcmvsp.cosim.errors import FederateError, place_of, words_of
from vcmvsp.cosim.metrics.motion import window_ns
from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.types import Array

Metric = Callable[[Any], Any]
"""Returns a number, or None where there is nothing to measure."""


class NoteStatistic:
    """A statistic of the numbers that agents note under one name, within the window of ``[metrics]``.

    Args:
        note: name of the note (`Agent.note`); true counts as 1, false as 0, text not at all
        value: mean, root mean square, least or greatest of these numbers; `final`: mean of each vehicle's last one
        vehicles: vehicles whose notes count; default: all
    """

    def __init__(
        self, note: str, value: Literal["mean", "rms", "min", "max", "final"] = "mean", vehicles: tuple[str, ...] = ()
    ) -> None:
        self._note, self._statistic, self.vehicles = note, STATISTICS[value], vehicles

    def __call__(self, run: Any) -> float | None:
        """The statistic; None without such notes."""
        begin_ns, end_ns = window_ns(run.window_s)
        time_ns, values = numbers(run.notes, "time_ns"), numbers(run.notes, "value", math.nan)
        (names, name), (vehicles, vehicle) = names_of(run.notes, "name"), names_of(run.notes, "vehicle")
        counted = (time_ns >= begin_ns) & (time_ns <= end_ns) & np.isfinite(values)
        counted &= np.isin(name, [code for code, each in enumerate(names) if each == self._note])
        counted &= np.isin(vehicle, [code for code, each in enumerate(vehicles) if not self.vehicles or each in self.vehicles])
        return self._statistic(values[counted], vehicle[counted]) if counted.any() else None


def _final(values: Array, vehicle: Array) -> float:
    """Mean over the vehicles of the last value of each."""
    _, places = np.unique(vehicle[::-1], return_index=True)
    return float(values[::-1][places].mean())


STATISTICS: Mapping[str, Callable[[Array, Array], float]] = {
    "mean": lambda values, _: float(values.mean()),
    "rms": lambda values, _: float(np.sqrt(np.mean(values**2))),
    "min": lambda values, _: float(values.min()),
    "max": lambda values, _: float(values.max()),
    "final": _final,
}
"""Statistics of values (n,) noted by vehicles with these codes (n,), in order of time."""


def maker_of(metric: Callable[..., Any]) -> Callable[..., Metric]:
    """The class of a metric; for a plain function of the run, a function that fixes its other parameters.

    Raises:
        ValueError: the function has no parameter for the run.
    """
    if isinstance(metric, type):
        return metric
    run, *others = inspect.signature(metric).parameters.values() or (None,)
    if run is None:
        raise ValueError(f"{metric.__name__}() must take the run, a vcmvsp.Result, as its first parameter")

    @functools.wraps(metric)
    def make(**parameters: Any) -> Metric:
        return functools.partial(metric, **parameters)

    make.__signature__ = inspect.Signature(others)  # type: ignore[attr-defined]
    return make


def own_values(metrics: Mapping[str, Metric], run: Any) -> tuple[dict[str, float | None], FederateError | None]:
    """The value of each metric, and the first error: a metric that fails has the value None."""
    values: dict[str, float | None] = {}
    failure: FederateError | None = None
    for name, metric in metrics.items():
        values[name] = None
        try:
            values[name] = _number(metric(run))
        except Exception as error:
            details = "".join(traceback.format_exception(error))
            failure = failure or FederateError(f"metrics.own.{name}", f"{words_of(error)}{place_of(error)}", details=details)
    return values, failure


def _number(value: Any) -> float | None:
    """A number of Python, NumPy or Arrow as Python's; None for None, NaN and infinity."""
    for convert in ("item", "as_py"):
        if hasattr(value, convert):
            value = getattr(value, convert)()
    if value is not None and not isinstance(value, int | float):
        raise TypeError(f"returned {type(value).__name__}, not a number or None")
    return None if isinstance(value, float) and not math.isfinite(value) else value
