"""Checks of user-defined layers: an error names the layer, its class and the required return value.

Assembly of a scenario replaces a user-defined class by a subclass with checks; built-in layers are not checked.
"""

import inspect
import operator
import types
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.config.binding import show
from vcmvsp.cosim.errors import FederateError, VcmvspError, place_of, words_of
from vcmvsp.cosim.tables.radio_frames import UNDER_WAY
from vcmvsp.netsim.channel.reception import RECEIVED
from vcmvsp.netsim.interfaces.layers import distance_of, unless_nothing
from vcmvsp.netsim.interfaces.medium import Decided, Fate
from vcmvsp.netsim.phy.error_rate import ErrorRate

Array = NDArray[Any]

_BOUND_NS = 2**62  # largest magnitude: sums of two fit into 64 bits


class LayerError(FederateError):
    """A user-defined layer is invalid or has raised an exception; ``layer``: its name in the chain."""

    def __init__(self, layer: str, kind: type, problem: str) -> None:
        self.layer = layer
        super().__init__("radio", f"{layer} {kind.__name__}{_defined_at(kind)}: {problem}")


def is_own(kind: object) -> bool:
    """Whether the kind of a layer is a user-defined class."""
    return isinstance(kind, type) and kind.__module__.partition(".")[0] != "vcmvsp"


def guarded(layer: str, kind: Any) -> Any:
    """The class; if user-defined, a subclass that checks return values. ``layer``: its name in messages."""
    opened = _medium if layer == "mac" else _anything
    return _guarded(layer, kind, _CHECKS | {"open": opened}) if is_own(kind) else kind


def check_attributes(layer: str, built: Any) -> None:
    """Reject a user-defined layer with a missing or invalid attribute."""
    if unless_nothing(built) is None or not is_own(kind := type(built)):
        return
    for name, (fits, must) in _ATTRIBUTES.get(layer, {}).items():
        try:
            value = getattr(built, name)
        except AttributeError:
            if name in _OPTIONAL:
                continue
            raise LayerError(layer, kind, f"has no {name}: {must}") from None
        except Exception as error:
            raise LayerError(layer, kind, f"{name}: {words_of(error)}{place_of(error)}") from error
        if not fits(value):
            raise LayerError(layer, kind, f"{name} must be {must}, not {show(value)}")


def _defined_at(kind: type) -> str:
    """Source location of a class, as part of a message."""
    (*_, kind) = [each for each in kind.__mro__ if (each.__module__, each.__qualname__) == (kind.__module__, kind.__qualname__)]
    try:
        lines, first = inspect.getsourcelines(kind)
        file = inspect.getfile(kind)
    except (OSError, TypeError):
        return ""
    decorators = next(k for k, line in enumerate(lines) if line.lstrip().startswith("class ") or k + 1 == len(lines))
    return f" ({Path(file).name} line {first + decorators})"


# --- answers ------------------------------------------------------------------------------------------------------------------

Check = Callable[..., Any]
"""From an answer and the arguments to the answer in the types that the channel needs; a ValueError says what it must be."""


def _guarded(layer: str, kind: type, checks: dict[str, Check]) -> type:
    """A subclass of ``kind`` whose methods check their return values."""

    def asked(verb: str, check: Check) -> Callable[..., Any]:
        def method(self: Any, *args: Any) -> Any:
            try:
                answer = getattr(super(derived, self), verb)(*args)
            except (VcmvspError, KeyboardInterrupt):
                raise
            except BaseException as error:  # user code may raise anything
                raise LayerError(layer, kind, f"{words_of(error)}{place_of(error)}") from error
            try:
                return check(answer, *args)
            except ValueError as error:
                raise LayerError(layer, kind, f"{verb} must return {error}") from error

        return method

    has = [verb for verb in checks if callable(getattr(kind, verb, None))]
    own = [verb for verb in has if not verb.endswith("_by") or {verb, verb.removesuffix("_by")} <= vars(kind).keys()]
    methods: dict[str, Any] = {"__module__": kind.__module__, "__qualname__": kind.__qualname__}
    methods |= {verb: asked(verb, checks[verb]) for verb in own}
    derived = types.new_class(kind.__name__, (kind,), exec_body=lambda names: names.update(methods))
    return derived


def _array(answer: object, shape: tuple[int, ...], must: str, kinds: str, fits: Callable[[Array], Array]) -> Array:
    """The answer as an array of this shape, of one of the kinds of dtype, with values that fit."""
    try:
        array = np.asarray(answer)
    except ValueError:  # lists of different lengths
        array = np.array(None)
    if array.shape != shape:
        problem = f"shape {array.shape}" if array.ndim else f"a scalar, {show(answer)}"
    elif array.size and array.dtype.kind not in kinds:
        problem = f"dtype {array.dtype}"
    elif not (good := fits(array)).all():
        problem = f"an array with the value {array[~good][0]}"
    else:
        return array
    raise ValueError(f"an array of {must}, shape {shape}, not {problem}")


def _floats(answer: object, shape: tuple[int, ...], must: str, fits: Callable[[Array], Array] = np.isfinite) -> Array:
    return _array(answer, shape, must, "fiu", fits).astype(np.float64, copy=False)


def _bools(answer: object, shape: tuple[int, ...]) -> Array:
    return _array(answer, shape, "booleans", "b", lambda _: np.ones(shape, np.bool_)).astype(np.bool_, copy=False)


def _times(answer: object, shape: tuple[int, ...]) -> Array:
    array = _array(answer, shape, "whole numbers of ns (int64)", "iu", lambda array: (array > -_BOUND_NS) & (array < _BOUND_NS))
    return array.astype(np.int64, copy=False)


def _anything(answer: object, *_: object) -> object:
    return answer


def _shape(argument: Any) -> tuple[int, ...]:
    """Shape of the answer: of paths, of distances, or of the receivers of a frame."""
    return distance_of(getattr(argument, "paths", argument)).shape


def _loss_db(answer: object, paths: Any, *_: object) -> Array:
    return _floats(answer, _shape(paths), "finite numbers (dB)")


def _through(answer: Any, paths: Any) -> tuple[Array, Array, tuple[str, ...]]:
    shape = _shape(paths)
    if not isinstance(answer, tuple) or len(answer) != 3 or not _are_names(answer[2]) or len(answer[2]) != shape[0]:
        raise ValueError(f"a tuple of loss (dB), number of walls and their materials, shape {shape} each, not {show(answer)}")
    count = _array(answer[1], shape, "numbers of walls", "iu", lambda array: array >= 0)
    return _loss_db(answer[0], paths), count.astype(np.int64, copy=False), tuple(answer[2])


def _lost(answer: object, frame: Any, *_: object) -> Array:
    return _bools(answer, _shape(frame))


def _interference_mw(answer: object, _: int, __: int, rx: Array, *___: object) -> Array:
    must = "finite numbers of at least 0 (mW)"
    return _floats(answer, rx.shape[:1], must, lambda array: np.isfinite(array) & (array >= 0))


def _deliver(answer: Any, _: int, __: object, received_ns: Array, *___: object) -> tuple[Array, Array]:
    if not isinstance(answer, tuple) or len(answer) != 2:
        raise ValueError(f"a tuple of arrival and copy (ns), shape {received_ns.shape} each, not {show(answer)}")
    arrival, copy = (_times(each, received_ns.shape) for each in answer)
    received = received_ns >= 0
    if (received & (arrival != -1) & (arrival < received_ns)).any() or (~received & (arrival != -1)).any():
        raise ValueError(f"arrivals (ns) at or after received_ns, or -1 for never and for frames not received, not {arrival}")
    if ((copy != -1) & ((arrival < 0) | (copy < arrival))).any():
        raise ValueError(f"copies (ns) at or after arrivals, or -1 for no copy and for frames that never arrive, not {copy}")
    return arrival, copy


def _air_time_ns(answer: Any, *_: object) -> int:
    try:
        air_ns = 0 if isinstance(answer, bool | np.bool_) else operator.index(answer)
    except TypeError:
        air_ns = 0
    if not 1 <= air_ns < _BOUND_NS:
        raise ValueError(f"a whole number of at least 1 (ns), not {show(answer)}")
    return air_ns


def _names(answer: Any, *_: object) -> Any:
    if not _are_names(answer):
        raise ValueError(f"a tuple of strings, not {show(answer)}")
    return answer


def _are_names(value: Any) -> bool:
    return isinstance(value, list | tuple) and all(isinstance(each, str) for each in value)


def _medium(answer: Any, _: object, count: int, *__: object) -> Any:
    """A user-defined medium, checked as its mac is."""
    if answer is None:
        return None
    needed = ("expect(frames)", "offer(frame)", "advance(until_ns)", "next_ns()")
    if not all(callable(getattr(answer, each.partition("(")[0], None)) for each in needed):
        raise ValueError(f"None, or a medium with {', '.join(needed)}, not {show(answer)}")
    if is_own(kind := type(answer)):
        checks: dict[str, Check] = {"expect": _anything, "offer": _anything, "foresee": _anything, "next_ns": _next_ns}
        derived = _guarded("mac", kind, checks | {"advance": partial(_decided, count=count)})
        object.__setattr__(answer, "__class__", derived)
    return answer


def _next_ns(answer: Any) -> int | None:
    if answer is not None and (isinstance(answer, bool) or not isinstance(answer, int | np.integer)):
        raise ValueError(f"a time (ns) as a whole number, or None, not {show(answer)}")
    return None if answer is None else int(answer)


def _decided(answer: Any, _: int, *, count: int) -> Any:
    if not isinstance(answer, list | tuple) or not all(isinstance(each, Decided) for each in answer):
        raise ValueError(f"a list of Decided, not {show(answer)}")
    for each in answer:
        _array(each.fate, (count,), "codes of Fate", "iu", lambda array: (array >= 0) & (array < len(Fate)))
        _floats(each.least_sinr, (count,), "ratios of powers", lambda array: ~np.isinf(array))
    return answer


_LEVEL_DBM = "numbers (dBm; NaN = not in the trace)"
_CHECKS: dict[str, Check] = {
    "loss_db": _loss_db,
    "through": _through,
    "gain_db": _loss_db,
    "air_time_ns": _air_time_ns,
    "lost": _lost,
    "lost_by": lambda answer, draws: _bools(answer, draws.shape[:-1]),
    "delay_ns": lambda answer, frame, *_: _times(answer, _shape(frame)),
    "delay_ns_by": lambda answer, draws: _times(answer, draws.shape[:-1]),
    "level_dbm": lambda answer, frame: _floats(answer, _shape(frame), _LEVEL_DBM, lambda array: ~np.isinf(array)),
    "traced": _lost,
    "interference_mw": _interference_mw,
    "deliver": _deliver,
    "names": _names,
    "unmatched": _names,
}

# --- attributes ---------------------------------------------------------------------------------------------------------------


def _is_number(value: object) -> bool:
    return isinstance(value, int | float | np.integer | np.floating) and not isinstance(value, bool) and not np.isnan(value)


_CAUSE = {
    "cause": (
        lambda value: isinstance(value, str) and value.strip() and value not in (RECEIVED, UNDER_WAY),
        f"the cause of loss in recordings: a text other than '{RECEIVED}' and '{UNDER_WAY}'",
    )
}
_LEVEL = (lambda value: _is_number(value) and value < np.inf, "a number (dB, dBm)")
_COLUMNS = (_are_names, "a tuple of the trace's quantities: 'snr_db' or 'rssi_dbm', 'loss', 'delay_s'")
_OPTIONAL = ("noise_dbm", "preamble_snr_db", "errors")
_ATTRIBUTES: dict[str, dict[str, tuple[Callable[[Any], Any], str]]] = {
    "phy": {
        **dict.fromkeys(("tx_power_dbm", "sensitivity_dbm", "noise_dbm", "preamble_snr_db"), _LEVEL),
        "errors": (
            lambda value: value is None or isinstance(value, ErrorRate),
            "None or a vcmvsp.netsim.phy.error_rate.ErrorRate",
        ),
    },
    "loss": _CAUSE,
    "script": _CAUSE,
    "trace": {**_CAUSE, "columns": _COLUMNS},
    "delivery": _CAUSE,
}
