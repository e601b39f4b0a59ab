"""Values as MessagePack bytes, exactly: floats keep every bit, arrays travel as (dtype, shape, raw bytes)."""

import re
from typing import Any, Generic, TypeVar

import msgspec
import numpy as np

from cosim.types import Later

T = TypeVar("T")


def encode(value: Any) -> bytes:
    """Any `cosim.types` value, or a structure of them, as bytes; what cannot be sent raises a `ValueError`."""
    try:
        return _encoder.encode(value)
    except (TypeError, NotImplementedError, OverflowError) as error:
        raise ValueError(f"{error}") from error


class Decoder(Generic[T]):
    """Reads bytes of one type; anything else raises a `ValueError` (msgspec's errors are such)."""

    def __init__(self, kind: Any) -> None:
        self._decoder: msgspec.msgpack.Decoder[T] = msgspec.msgpack.Decoder(kind, dec_hook=_decode_array)

    def decode(self, data: bytes) -> T:
        """The value."""
        return self._decoder.decode(data)


def _encode_other(value: Any) -> Any:
    if isinstance(value, Later):
        return value.get()
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes()
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"cannot send a {type(value).__name__}")


def _decode_array(kind: Any, value: Any) -> Any:
    """A read-only view of the bytes; dtypes that hold Python objects are refused."""
    if getattr(kind, "__origin__", kind) is not np.ndarray:
        raise NotImplementedError(f"cannot read a {kind}")
    dtype, shape, raw = value
    if not re.fullmatch(r"[<>|=]?[biuf]\d+", dtype):
        raise ValueError(f"arrays of {dtype!r} do not travel")
    return np.frombuffer(raw, np.dtype(dtype)).reshape(shape)


_encoder = msgspec.msgpack.Encoder(enc_hook=_encode_other)
