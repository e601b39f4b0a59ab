"""Values as MessagePack bytes, exactly: floats keep every bit, arrays travel as (dtype, shape, raw bytes).

In a message of many arrays (`pack`) these follow the MessagePack, grouped by type and shape. It begins with the byte 0xC1,
which MessagePack never uses, and the sizes of two pieces of MessagePack (bytes, unsigned 64-bit, little-endian). The first
piece is the value, with a number in place of each array, from 0 on. The second lists the groups in the order of these numbers:
dtype, shape and number of arrays.
"""

import math
import struct
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import chain, groupby
from typing import Annotated, Any, Generic, TypeVar

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
"""Types of arrays that can be encoded, by name: numbers and booleans in either byte order."""
_NAMES = {dtype: name for name, dtype in _TYPES.items()}

_MARK = b"\xc1"
_head = struct.Struct("<cQQ")

_Size = Annotated[int, msgspec.Meta(ge=0, le=2**48)]


def type_of(name: str) -> np.dtype[Any]:
    """The array type of this exact name; `ValueError` if such arrays cannot be encoded."""
    dtype = _TYPES.get(name)
    if dtype is None:  # a dtype may be falsy
        raise ValueError(f"arrays of {name!r} cannot be sent")
    return dtype


def name_of(dtype: np.dtype[Any]) -> str:
    """The name of an array type; `ValueError` if its arrays cannot be encoded."""
    name = _NAMES.get(dtype)
    if name is None:
        raise ValueError(f"cannot send arrays of {dtype}")
    return name


def numbers(dtype: np.dtype[Any], raw: bytes) -> Array:
    """A read-only array over the bytes."""
    array = np.frombuffer(raw, dtype)
    if dtype.kind == "b" and array.view(np.uint8).max(initial=0) > 1:
        raise ValueError("a boolean is neither 0 nor 1")
    return array


def other(value: object) -> object:
    """Substitute for values that MessagePack lacks: an array as (dtype, shape, raw bytes), a NumPy number as a plain one."""
    if isinstance(value, np.ndarray):
        return name_of(value.dtype), value.shape, _bytes_of(value)
    if isinstance(value, Later):
        return value.get()
    if isinstance(value, np.generic):
        return value.item()
    raise NotImplementedError(f"cannot send a {type(value).__name__}")


def _bytes_of(array: Array) -> bytes | memoryview:
    """The bytes of an array, in C order; a copy only if they lie in another."""
    return array.data if array.flags.c_contiguous else array.tobytes()


def encode(value: object, other: Callable[[Any], object] = other) -> bytes:
    """Any `cosim.types` value, or a structure of them, as bytes; `ValueError` if it cannot be encoded."""
    try:
        return msgspec.msgpack.encode(value, enc_hook=other)
    except (TypeError, NotImplementedError, OverflowError, RecursionError) as error:
        raise ValueError(f"{error}") from error


def _array(_: type, value: Any) -> Array:
    """The array that `other` has encoded."""
    name, shape, raw = value
    array = numbers(type_of(name), raw)
    if shape != [len(array)]:
        array = array.reshape(shape)
        if list(array.shape) != shape:  # e.g. a size of -1, which NumPy would infer
            raise ValueError(f"{name!r} of shape {shape!r} is not a valid description of an array")
    return array


class Decoder(Generic[T]):
    """Decodes bytes to one type; anything else raises a `ValueError` (msgspec's errors are such).

    Args:
        array: makes an array of its encoded form.
    """

    def __init__(self, kind: object, array: Callable[[type, Any], Array] = _array) -> None:
        self._decoder: msgspec.msgpack.Decoder[T] = msgspec.msgpack.Decoder(kind, dec_hook=array)

    def decode(self, data: bytes | memoryview) -> T:
        """The decoded value."""
        try:
            return self._decoder.decode(data)
        except RecursionError:
            raise ValueError("lists and mappings are nested too deeply") from None
        except msgspec.ValidationError as error:  # the message repeats its input, which may contain terminal sequences
            raise msgspec.ValidationError(repr(str(error))[1:-1][:LONGEST_ERROR]) from None


class _Alike(msgspec.Struct, frozen=True, array_like=True):
    dtype: str
    shape: Annotated[list[_Size], msgspec.Meta(max_length=32)]
    count: Annotated[int, msgspec.Meta(ge=1, le=2**48)]


_tables: Decoder[list[_Alike]] = Decoder(list[_Alike])


def pack(value: object) -> bytes:
    """The value as bytes, arrays grouped; `ValueError` if it cannot be encoded."""
    arrays: list[Array] = []

    def place(value: object) -> object:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return 0
        return other(value)

    content = encode(value, place)
    if not arrays:
        return content
    kinds = groupby([(each.dtype, each.shape) for each in arrays])
    table = encode([(name_of(dtype), shape, len(list(alike))) for (dtype, shape), alike in kinds])
    return b"".join([_head.pack(_MARK, len(content), len(table)), content, table, *map(_bytes_of, arrays)])


class Unpacker(Generic[T]):
    """Decodes the bytes of `pack` or `encode` to one type; anything else raises a `ValueError`."""

    def __init__(self, kind: object) -> None:
        self._plain: Decoder[T] = Decoder(kind)
        self._decoder: Decoder[T] = Decoder(kind, self._next)
        self._arrays: Iterator[Array] = iter(())  # remaining arrays of the current message
        self._lock = threading.Lock()  # runs may share it between threads

    def decode(self, data: bytes | memoryview) -> T:
        """The decoded value; its arrays are read-only views of the data."""
        if data[:1] != _MARK:
            return self._plain.decode(data)
        with self._lock:
            content, self._arrays = _apart(memoryview(data))
            value = self._decoder.decode(content)
            if next(self._arrays, None) is not None:
                raise ValueError("an array without a reference")
            return value

    def _next(self, _: type, place: object) -> Array:
        array = next(self._arrays, None)
        if place != 0 or array is None:
            raise ValueError("a missing array")
        return array


def _apart(data: memoryview) -> tuple[memoryview, Iterator[Array]]:
    """The encoded value and the arrays; the sizes in a message cannot demand more memory than the message has."""
    if len(data) < _head.size:
        raise ValueError("it breaks off")
    _, size, rest = _head.unpack_from(data)
    content, raw = data[_head.size :][:size], data[_head.size :][size:]
    table, raw = raw[:rest], raw[rest:]
    blocks: list[Iterable[Array]] = []
    for kind in _tables.decode(table):
        dtype = type_of(kind.dtype)
        size = kind.count * math.prod(kind.shape) * dtype.itemsize
        if len(raw) < size:
            raise ValueError("it breaks off")
        block = numbers(dtype, bytes(raw[:size])).reshape(kind.count, *kind.shape)
        if kind.shape:
            blocks.append(block)
        else:
            blocks.append(each.reshape(()) for each in block.reshape(-1, 1))
        raw = raw[size:]
    if raw:
        raise ValueError("more arrays than announced")
    return content, chain.from_iterable(blocks)
