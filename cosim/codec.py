"""Values as MessagePack bytes, exactly: floats keep every bit, arrays travel as (dtype, shape, raw bytes)."""

import re
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np

from cosim.types import Later

T = TypeVar("T")
LONGEST_ERROR = 300  # characters


def encode(value: Any) -> bytes:
    """Any `cosim.types` value, or a structure of them, as bytes; what cannot be sent raises a `ValueError`."""
    try:
        return _encoder.encode(value)
    except (TypeError, NotImplementedError, OverflowError, RecursionError) as error:
        raise ValueError(f"{error}") from error


class Decoder(Generic[T]):
    """Reads bytes of one type; anything else raises a `ValueError` (msgspec's errors are such)."""

    def __init__(self, kind: Any) -> None:
        self._decoder: msgspec.msgpack.Decoder[T] = msgspec.msgpack.Decoder(kind, dec_hook=_decode_array)

    def decode(self, data: bytes | memoryview) -> T:
        """The value."""
        try:
            return self._decoder.decode(data)
        except RecursionError:
            raise ValueError("lists and mappings are nested too deeply") from None
        except msgspec.ValidationError as error:  # it repeats what it was given, which may be meant for a terminal
            raise msgspec.ValidationError(repr(str(error))[1:-1][:LONGEST_ERROR]) from None


def _encode_other(value: Any) -> Any:
    if isinstance(value, np.ndarray) and (name := _names.get(value.dtype) or _name(value.dtype)):
        return name, value.shape, value.data if value.flags.c_contiguous else value.tobytes()
    if isinstance(value, Later):
        return value.get()
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"cannot send a {type(value).__name__}")


def _decode_array(_: Any, value: Any) -> Any:
    """A read-only view of the bytes, said just as `encode` says it; dtypes that hold Python objects are refused."""
    name, shape, raw = value
    dtype = _dtypes.get(name)  # which counts as false, though there is one
    array = np.frombuffer(raw, _dtype(name) if dtype is None else dtype)
    if shape != [len(array)]:
        array = array.reshape(shape)
        if list(array.shape) != shape:  # such as a size of -1, which NumPy works out
            raise ValueError(f"{name!r} of shape {shape!r} is no array's own description")
    if name == "|b1" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("a boolean is neither 0 nor 1")
    return array


def _name(dtype: np.dtype[Any]) -> str:
    """What a type says of itself; empty: its arrays do not travel."""
    return _names.setdefault(dtype, dtype.str) if dtype.kind in "biuf" else ""


def _dtype(name: str) -> np.dtype[Any]:
    """The type that says its name just so; few do, so that they can be kept."""
    if not re.fullmatch(r"[<>|][biuf]\d+", name) or (dtype := np.dtype(name)).str != name:
        raise ValueError(f"arrays of {name!r} do not travel")
    return _dtypes.setdefault(name, dtype)


_dtypes: dict[str, np.dtype[Any]] = {}
_names: dict[np.dtype[Any], str] = {}
_encoder = msgspec.msgpack.Encoder(enc_hook=_encode_other)
