"""Messages whose arrays lie behind them come back bit for bit; what says more than it has is refused."""

import random
import tracemalloc
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.cosim.util.test_codec import ARRAYS, bits
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.types import Array, Later, Mosaic, Scan, VehicleState
from vcmvsp.cosim.util import codec

LISTS: codec.Unpacker[list[Array]] = codec.Unpacker(list[Array])
SCAN = Scan(ranges=np.linspace(0.1, 9.9, 16, dtype=np.float32), angle_min=-2.0, angle_step=0.01, range_max=10.0)
STATE = VehicleState(position=(1.0, -0.0, 5e-324))


def packed(*kinds: Any, content: Any = (0,), raw: bytes = b"") -> bytes:
    """A message as somebody may forge it."""
    value, table = msgspec.msgpack.encode(content), msgspec.msgpack.encode(kinds)
    return b"\xc1" + len(value).to_bytes(8, "little") + len(table).to_bytes(8, "little") + value + table + raw


@given(st.lists(ARRAYS, max_size=6))
def test_arrays_come_back_in_order_and_cannot_be_written(arrays: list[Array]) -> None:
    back = LISTS.decode(codec.pack(arrays))
    assert bits(back) == bits(arrays)
    for each in back:
        assert not each.flags.writeable
        with pytest.raises(ValueError, match="WRITEABLE"):
            each.flags.writeable = True


@given(st.lists(ARRAYS, max_size=6))
def test_arrays_in_their_places_are_read_as_well(arrays: list[Array]) -> None:
    assert bits(LISTS.decode(codec.encode(arrays))) == bits(arrays)


@pytest.mark.parametrize("vehicles", [1, 20])
def test_a_step_of_few_and_of_many_is_read_as_it_was_sent(vehicles: int) -> None:
    inbox = [Event(f"car{n}/scan", 5, SCAN) for n in range(vehicles)]
    read = protocol.questions.decode(protocol.encode(protocol.Act(5, inbox)))
    assert isinstance(read, protocol.Act)
    assert codec.encode(read) == codec.encode(protocol.Act(5, inbox))


def test_they_lie_where_numpy_works_quickest() -> None:
    arrays: list[Array] = [np.zeros(3, np.uint8), *np.arange(12.0).reshape(4, 3), np.zeros(1, np.int16), np.arange(3.0)]
    assert all(each.flags.aligned and each.flags.c_contiguous for each in LISTS.decode(codec.pack(arrays)))


@given(ARRAYS)
def test_how_an_array_lies_in_memory_is_not_seen(value: Array) -> None:
    strided = np.repeat(value[..., None], 2, axis=-1)[..., 0]
    assert codec.pack([np.array(value, order="F"), strided]) == codec.pack([value, value])


def test_questions_and_answers_carry_them() -> None:
    later: Any = Later(lambda: SCAN)
    asked = protocol.Act(7, [Event("a/scan", 7, SCAN), Event("a/estimate", 7, STATE), Event("b/scan", 7, later)])
    back = protocol.questions.decode(protocol.encode(asked))
    assert bits(back) == bits(protocol.Act(7, [*asked.inbox[:2], Event("b/scan", 7, SCAN)]))
    seen = Mosaic(left=0.0, bottom=0.0, cell_m=1.0, pixels=np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    said = protocol.Stepped([Event("a/mosaic", 7, seen)])
    assert bits(protocol.answers.decode(protocol.encode(said))) == bits(said)


def test_a_message_without_arrays_is_plain() -> None:
    asked = protocol.Act(7, [Event("a/estimate", 7, STATE)])
    assert protocol.encode(asked) == codec.encode(asked)


FORGED = {
    "a head that breaks off": packed(("<f8", [1], 1), raw=b"\0" * 8)[:16],
    "a value that breaks off": packed(("<f8", [1], 1), raw=b"\0" * 8)[:17],
    "too few bytes": packed(("<f8", [2], 1), raw=b"\0" * 8),
    "too many bytes": packed(("<f8", [1], 1), raw=b"\0" * 9),
    "too few arrays": packed(("<f8", [1], 1), content=(0, 0), raw=b"\0" * 8),
    "too many arrays": packed(("<f8", [1], 2), raw=b"\0" * 16),
    "too many of none": packed(content=(0,)),
    "an array in its place": packed(("<f8", [1], 1), content=[("<f8", [1], b"\0" * 8)], raw=b"\0" * 8),
    "another number in its place": packed(("<f8", [1], 1), content=(1,), raw=b"\0" * 8),
    "no dtype": packed(("no dtype", [1], 1), raw=b"\0" * 8),
    "objects": packed(("|O", [1], 1), raw=b"\0" * 8),
    "this machine's own order of bytes": packed(("f8", [1], 1), raw=b"\0" * 8),
    "a size for NumPy to work out": packed(("<f8", [-1], 1), raw=b"\0" * 8),
    "no arrays of a kind": packed(("<f8", [1], 0), content=()),
    "a boolean that is none": packed(("|b1", [2], 1), raw=b"\1\2"),
    "more dimensions than there are": packed(("<f8", [1] * 65, 1), raw=b"\0" * 8),
    "sizes beyond all memory": packed(("<f8", [2**40, 2**40], 1), raw=b"\0" * 8),
    "sizes beyond all memory, of nothing": packed(("<f8", [0, 2**48, 2**48], 2**48)),
    "as many of nothing": packed(("<f8", [0], 2**48)),
    "numbers beyond 64 bits": packed(("<f8", [2**64 - 1], 2**64 - 1)),
    "a table that is none": packed(3),
}


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED.keys())
def test_what_is_forged_is_a_value_error(forged: bytes) -> None:
    with pytest.raises(ValueError, match=r".+"):
        LISTS.decode(forged)
    assert LISTS.decode(codec.pack([np.zeros(1)])) == [0.0]  # the next message is read


def test_what_a_message_says_of_itself_takes_no_memory() -> None:
    tracemalloc.start()
    for kind in (("<f8", [0], 2**48), ("<f8", [2**20, 2**20], 1), ("|u1", [], 2**40)):
        with pytest.raises(ValueError, match=r".+"):
            LISTS.decode(packed(kind))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 100_000


def test_noise_is_a_value_error_or_another_message() -> None:
    draw = random.Random(5)
    honest = protocol.encode(
        protocol.Act(7, [Event("a/scan", 7, SCAN), Event("a/estimate", 7, STATE), Event("b/scan", 7, SCAN)])
    )
    refused = 0
    for _ in range(3000):
        data = bytearray(honest)
        for _ in range(draw.choice([1, 2, 8])):
            data[draw.randrange(min(len(data), draw.choice([17, 1000])))] ^= 1 << draw.randrange(8)
        try:
            protocol.encode(protocol.questions.decode(bytes(data[: draw.choice([len(data), draw.randrange(len(data))])])))
        except ValueError:
            refused += 1
    assert refused > 1000
    assert isinstance(protocol.questions.decode(honest), protocol.Act)
