"""Values as MessagePack bytes, exactly: floats keep every bit, arrays travel as (dtype, shape, raw bytes)."""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, Later

T = TypeVar("T")
LONGEST_ERROR = 300  # characters

_TYPES = {
    dtype.str: dtype
    for code in np.typecodes["AllInteger"] + np.typecodes["Float"] + "?"
    for dtype in (np.dtype(code), np.dtype(code).newbyteorder())
}
"""Of arrays that travel: numbers and booleans in either byte order, by what they say of themselves."""
_NAMES = {dtype: name for name, dtype in _TYPES.items()}


def type_of(name: str) -> np.dtype[Any]:
    """The type of arrays that says its name just so; a `ValueError` if such arrays do not travel."""
    dtype = _TYPES.get(name)
    if dtype is None:  # the type itself counts as false
        raise ValueError(f"arrays of {name!r} do not travel")
    return dtype


def name_of(dtype: np.dtype[Any]) -> str:
    """What the type says of itself; a `ValueError` if its arrays do not travel."""
    name = _NAMES.get(dtype)
    if name is None:
        raise ValueError(f"cannot send arrays of {dtype}")
    return name


def numbers(dtype: np.dtype[Any], raw: bytes) -> Array:
    """A read-only view of the bytes."""
    array = np.frombuffer(raw, dtype)
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("a boolean is neither 0 nor 1")
    return array


def other(value: object) -> object:
    """In place of what MessagePack does not have: an array as (dtype, shape, raw bytes), a number of NumPy's as a plain one."""
    if isinstance(value, np.ndarray):
        return name_of(value.dtype), value.shape, value.data if value.flags.c_contiguous else value.tobytes()
    if isinstance(value, Later):
        return value.get()
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"cannot send a {type(value).__name__}")


def encode(value: object, other: Callable[[Any], object] = other) -> bytes:
    """Any `cosim.types` value, or a structure of them, as bytes; what cannot be sent raises a `ValueError`."""
    try:
        return msgspec.msgpack.encode(value, enc_hook=other)
    except (TypeError, NotImplementedError, OverflowError, RecursionError) as error:
        raise ValueError(f"{error}") from error


def _array(_: type, value: Any) -> Array:
    """What is said just as `other` says it."""
    name, shape, raw = value
    array = numbers(type_of(name), raw)
    if shape != [len(array)]:
        array = array.reshape(shape)
        if list(array.shape) != shape:  # such as a size of -1, which NumPy works out
            raise ValueError(f"{name!r} of shape {shape!r} is no array's own description")
    return array


class Decoder(Generic[T]):
    """Reads bytes of one type; anything else raises a `ValueError` (msgspec's errors are such).

    Args:
        kind: the type.
        array: gives an array for what stands in its place.
    """

    def __init__(self, kind: object, array: Callable[[type, Any], Array] = _array) -> None:
        self._decoder: msgspec.msgpack.Decoder[T] = msgspec.msgpack.Decoder(kind, dec_hook=array)

    def decode(self, data: bytes | memoryview) -> T:
        """The value."""
        try:
            return self._decoder.decode(data)
        except RecursionError:
            raise ValueError("lists and mappings are nested too deeply") from None
        except msgspec.ValidationError as error:  # it repeats what it was given, which may be meant for a terminal
            raise msgspec.ValidationError(repr(str(error))[1:-1][:LONGEST_ERROR]) from None
