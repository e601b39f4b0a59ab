"""Messages with many arrays: MessagePack, and behind it the bytes of all arrays, those of one type and shape together.

Such a message begins with the byte 0xC1, which no MessagePack does, and the sizes of two pieces of MessagePack (bytes,
unsigned 64-bit, little-endian). The first is the value, with a number in place of each array, from 0 on. The second says what
follows: dtype, shape, and how many arrays there are of that kind, in the order of their numbers. A message of few arrays is
MessagePack with each in its place (`cosim.util.codec`).
"""

import math
import struct
import threading
from collections.abc import Iterable, Iterator
from itertools import chain, groupby
from typing import Annotated, Generic, TypeVar

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util import codec

T = TypeVar("T")
_MARK = b"\xc1"
_head = struct.Struct("<cQQ")

_Size = Annotated[int, msgspec.Meta(ge=0, le=2**48)]


class _Alike(msgspec.Struct, frozen=True, array_like=True):
    """Arrays of one kind, one behind the other."""

    dtype: str
    shape: Annotated[list[_Size], msgspec.Meta(max_length=32)]
    count: Annotated[int, msgspec.Meta(ge=1, le=2**48)]


_tables: codec.Decoder[list[_Alike]] = codec.Decoder(list[_Alike])


def pack(value: object) -> bytes:
    """The value as bytes; what cannot be sent raises a `ValueError`."""
    arrays: list[Array] = []

    def other(value: object) -> object:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return 0
        return codec.other(value)

    content = codec.encode(value, other)
    if not arrays:
        return content
    kinds = groupby([(each.dtype, each.shape) for each in arrays])
    table = codec.encode([(codec.name_of(dtype), shape, len(list(alike))) for (dtype, shape), alike in kinds])
    raw = [each if each.flags.c_contiguous else each.tobytes() for each in arrays]
    return b"".join([_head.pack(_MARK, len(content), len(table)), content, table, *raw])  # type: ignore[list-item]


class Unpacker(Generic[T]):
    """Reads what `pack` or `codec.encode` has written, of one type; anything else raises a `ValueError`."""

    def __init__(self, kind: object) -> None:
        self._plain: codec.Decoder[T] = codec.Decoder(kind)
        self._decoder: codec.Decoder[T] = codec.Decoder(kind, self._next)
        self._arrays: Iterator[Array] = iter(())  # of the message that is being read, as many as are left
        self._lock = threading.Lock()  # there may be runs in other threads

    def decode(self, data: bytes | memoryview) -> T:
        """The value; each of its arrays is a read-only view of the bytes of its kind."""
        if data[:1] != _MARK:
            return self._plain.decode(data)
        with self._lock:
            content, self._arrays = _apart(memoryview(data))
            value = self._decoder.decode(content)
            if next(self._arrays, None) is not None:
                raise ValueError("an array that belongs nowhere")
            return value

    def _next(self, _: type, place: object) -> Array:
        array = next(self._arrays, None)
        if place != 0 or array is None:
            raise ValueError("an array that is not there")
        return array


def _apart(data: memoryview) -> tuple[memoryview, Iterator[Array]]:
    """The value, and its arrays; what a message says of itself takes no more memory than the message."""
    if len(data) < _head.size:
        raise ValueError("it breaks off")
    _, size, rest = _head.unpack_from(data)
    content, raw = data[_head.size :][:size], data[_head.size :][size:]
    table, raw = raw[:rest], raw[rest:]
    blocks: list[Iterable[Array]] = []
    for kind in _tables.decode(table):
        dtype = codec.type_of(kind.dtype)
        size = kind.count * math.prod(kind.shape) * dtype.itemsize
        if len(raw) < size:
            raise ValueError("it breaks off")
        block = codec.numbers(dtype, bytes(raw[:size])).reshape(kind.count, *kind.shape)
        blocks.append(block if kind.shape else (each.reshape(()) for each in block.reshape(-1, 1)))
        raw = raw[size:]
    if raw:
        raise ValueError("more arrays than it says")
    return content, chain.from_iterable(blocks)
