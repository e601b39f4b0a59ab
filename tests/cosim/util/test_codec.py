"""Values are read back bit for bit; invalid values are refused."""

import random
import struct
import tracemalloc
import typing
from typing import Any, Literal

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from vcmvsp.cosim import types
from vcmvsp.cosim.federate import Event
from vcmvsp.cosim.frames import Quaternion
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.types import AnyValue, Array, Later, Mosaic, Scan, Vec3, VehicleState, Velocity
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.util.codec import Decoder, encode

pytestmark = pytest.mark.slow

FLOATS = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)
TEXT = st.text(max_size=8)
TIMES = st.integers(-(2**63), 2**63 - 1)
VEC3 = st.tuples(FLOATS, FLOATS, FLOATS)
QUATERNION = st.tuples(FLOATS, FLOATS, FLOATS, FLOATS)
DTYPES = (
    hnp.boolean_dtypes()
    | hnp.integer_dtypes(endianness="?")
    | hnp.unsigned_integer_dtypes(endianness="?")
    | hnp.floating_dtypes(sizes=(16, 32, 64), endianness="?")
)
ARRAYS = DTYPES.flatmap(lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, min_side=0, max_dims=3, max_side=4)))
PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | FLOATS | TEXT | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=6,
)

# By annotation: a new field of a value is tested without a new line here.
BY_ANNOTATION: dict[Any, st.SearchStrategy[Any]] = {
    Vec3: VEC3,
    Quaternion: QUATERNION,
    Array: ARRAYS,
    Array | None: ARRAYS | st.none(),
    Array | msgspec.UnsetType: ARRAYS | st.just(msgspec.UNSET),
    float: FLOATS,
    float | None: FLOATS | st.none(),
    int: TIMES,
    str: TEXT,
    bool: st.booleans(),
    bytes: st.binary(max_size=16),
    str | None: TEXT | st.none(),
    str | msgspec.UnsetType: TEXT | st.just(msgspec.UNSET),
    tuple[str, ...]: st.lists(TEXT, max_size=3).map(tuple),
    tuple[str, ...] | None: st.lists(TEXT, max_size=3).map(tuple) | st.none(),
    tuple[float, float]: st.tuples(FLOATS, FLOATS),
    Velocity | None: st.builds(Velocity, linear=VEC3, yaw_rate=FLOATS) | st.none(),
    dict[str, Any] | bytes: st.dictionaries(TEXT, PLAIN, max_size=3) | st.binary(max_size=16),
    dict[str, float]: st.dictionaries(TEXT, FLOATS, max_size=3),
    dict[str, float | str | bool]: st.dictionaries(TEXT, FLOATS | TEXT | st.booleans(), max_size=3),
}


def instances(kind: Any) -> st.SearchStrategy[Any]:
    if isinstance(kind, type) and issubclass(kind, types.Value):
        return st.builds(kind, **{name: instances(hint) for name, hint in typing.get_type_hints(kind).items()})
    if typing.get_origin(kind) is Literal:
        return st.sampled_from(typing.get_args(kind))
    if kind not in BY_ANNOTATION and typing.get_origin(kind) is tuple:
        return st.lists(instances(typing.get_args(kind)[0]), max_size=3).map(tuple)
    return BY_ANNOTATION[kind]


def bits(value: Any) -> Any:
    """A form in which only bit-equal values are equal (also NaN and -0.0)."""
    if isinstance(value, msgspec.Struct):
        return type(value).__name__, [bits(getattr(value, name)) for name in value.__struct_fields__]
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, dict):
        return {name: bits(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [bits(each) for each in value]
    return type(value).__name__, value


def arrays_in(value: Any) -> list[Array]:
    if isinstance(value, np.ndarray):
        return [value]
    if isinstance(value, msgspec.Struct):
        return [array for name in value.__struct_fields__ for array in arrays_in(getattr(value, name))]
    return []


anything: Decoder[Any] = Decoder(AnyValue)
array: Decoder[Array] = Decoder(Array)
events: Decoder[list[Event]] = Decoder(list[Event])


@pytest.mark.parametrize("kind", typing.get_args(AnyValue), ids=lambda kind: kind.__name__)
@settings(max_examples=40)
@given(data=st.data())
def test_every_value_comes_back_bit_for_bit(kind: Any, data: st.DataObject) -> None:
    value = data.draw(instances(kind))
    back = anything.decode(encode(value))
    assert bits(back) == bits(value)
    assert encode(back) == encode(value)
    assert not any(each.flags.writeable for each in arrays_in(back))


@given(st.lists(st.tuples(TEXT, TIMES, instances(types.VehicleState)), max_size=4))
def test_events_come_back_in_order(content: list[tuple[str, int, types.VehicleState]]) -> None:
    given_events = [Event(key, time_ns, value) for key, time_ns, value in content]
    assert bits(events.decode(encode(given_events))) == bits(given_events)


@given(ARRAYS)
def test_the_encoding_is_independent_of_memory_layout(value: Array) -> None:
    strided = np.repeat(value[..., None], 2, axis=-1)[..., 0]
    for write in (encode, codec.pack):
        assert write([np.array(value, order="F"), strided]) == write([value, value])


def test_read_arrays_cannot_be_written() -> None:
    back = array.decode(encode(np.zeros((2, 3))))
    with pytest.raises(ValueError, match="read-only"):
        back[0, 0] = 1.0
    with pytest.raises(ValueError, match="WRITEABLE"):
        back.flags.writeable = True


@pytest.mark.parametrize(
    "bad",
    [
        np.array([{}, None], object),
        np.array(["2012-01-01"], "datetime64[D]"),
        np.zeros(2, [("a", "f8")]),
        np.array([b"raw"]),
        np.array(["text"]),
        np.array([1j]),
    ],
    ids=lambda value: str(value.dtype),
)
def test_only_numbers_and_booleans_travel_in_arrays(bad: Array) -> None:
    with pytest.raises((msgspec.ValidationError, NotImplementedError, TypeError, ValueError)):
        array.decode(encode(bad))


@pytest.mark.parametrize(
    "forged",
    [
        ("|O", [1], b"\0" * 8),
        ("<f8", [2], b"\0" * 8),  # too few bytes
        ("<f8", [1], b"\0" * 9),
        ("no dtype", [1], b"\0"),
        pytest.param(("(2,", [1], b"\0")),
        (3, [1], b"\0"),
        ([["a", "<f8"]], [1], b"\0" * 8),
        ("<f8", "x", b""),
        ("<f8", [1]),
        ("<f8", [-1], b"\0" * 16),  # a size left to NumPy
        ("<f8", 1, b"\0" * 8),
        ("<f8", None, b"\0" * 8),
        ("f8", [1], b"\0" * 8),  # native byte order
        ("|b1", [2], b"\1\2"),
        ("<f8", [2**63], b""),
        ("<f8", [0, 2**62], b""),
        ("<f8", [1] * 65, b"\0" * 8),
        ("i0", [2**40], b""),
        ("i99999999999999999999", [1], b"\0"),
        {"dtype": "<f8"},
        None,
        "<f8",
    ],
    ids=repr,
)
def test_a_forged_array_is_a_validation_error(forged: Any) -> None:
    with pytest.raises(msgspec.ValidationError):
        array.decode(msgspec.msgpack.encode(forged))


@given(st.binary(max_size=64))
def test_noise_is_a_decoding_error(noise: bytes) -> None:
    decoders: tuple[Decoder[Any], ...] = (anything, array, events)
    for decoder in decoders:
        try:
            value = decoder.decode(noise)
        except ValueError:  # msgspec's errors, and UnicodeDecodeError
            continue
        encode(value)  # some noise is a value


@given(st.text(max_size=12), st.lists(st.integers(-2, 5), max_size=3), st.binary(max_size=32))
def test_noise_in_an_array_is_a_validation_error(dtype: str, shape: list[int], raw: bytes) -> None:
    try:
        value = array.decode(msgspec.msgpack.encode((dtype, shape, raw)))
    except msgspec.ValidationError:
        return
    assert value.dtype.kind in "biuf"


@pytest.mark.parametrize("number", [np.float64(0.1), np.float32(0.5), np.int64(-3), np.uint8(200), np.bool_(True)])
def test_numpy_numbers_travel_as_plain_ones(number: Any) -> None:
    assert encode(number) == msgspec.msgpack.encode(number.item())


@pytest.mark.parametrize("bad", [object(), 1j, {1, 2}.__iter__(), lambda: None], ids=lambda bad: type(bad).__name__)
def test_foreign_objects_are_not_sent(bad: Any) -> None:
    with pytest.raises(ValueError, match="cannot send"):
        encode(bad)


LISTS: codec.Unpacker[list[Array]] = codec.Unpacker(list[Array])
SCAN = Scan(ranges=np.linspace(0.1, 9.9, 16, dtype=np.float32), angle_min=-2.0, angle_step=0.01, range_max=10.0)
STATE = VehicleState(position=(1.0, -0.0, 5e-324))


def forged_message(*kinds: Any, content: Any = (0,), raw: bytes = b"") -> bytes:
    """A forged message."""
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
    assert bits(LISTS.decode(codec.encode(arrays))) == bits(arrays)  # inline arrays are read, too


@pytest.mark.parametrize("vehicles", [1, 20])
def test_a_step_of_few_and_of_many_is_read_back_unchanged(vehicles: int) -> None:
    inbox = [Event(f"car{n}/scan", 5, SCAN) for n in range(vehicles)]
    read = protocol.questions.decode(protocol.encode(protocol.Act(5, inbox)))
    assert isinstance(read, protocol.Act)
    assert codec.encode(read) == codec.encode(protocol.Act(5, inbox))


def test_arrays_are_aligned_and_contiguous() -> None:
    arrays: list[Array] = [np.zeros(3, np.uint8), *np.arange(12.0).reshape(4, 3), np.zeros(1, np.int16), np.arange(3.0)]
    assert all(each.flags.aligned and each.flags.c_contiguous for each in LISTS.decode(codec.pack(arrays)))


def test_questions_and_answers_have_arrays() -> None:
    later: Any = Later(lambda: SCAN)
    question = protocol.Act(7, [Event("a/scan", 7, SCAN), Event("a/estimate", 7, STATE), Event("b/scan", 7, later)])
    back = protocol.questions.decode(protocol.encode(question))
    assert bits(back) == bits(protocol.Act(7, [*question.inbox[:2], Event("b/scan", 7, SCAN)]))
    mosaic = Mosaic(left=0.0, bottom=0.0, cell_m=1.0, pixels=np.arange(12, dtype=np.uint8).reshape(2, 2, 3))
    answer = protocol.Stepped([Event("a/mosaic", 7, mosaic)])
    assert bits(protocol.answers.decode(protocol.encode(answer))) == bits(answer)


def test_a_message_without_arrays_is_plain() -> None:
    question = protocol.Act(7, [Event("a/estimate", 7, STATE)])
    assert protocol.encode(question) == codec.encode(question)


FORGED = {
    "a head that breaks off": forged_message(("<f8", [1], 1), raw=b"\0" * 8)[:16],
    "a value that breaks off": forged_message(("<f8", [1], 1), raw=b"\0" * 8)[:17],
    "too few bytes": forged_message(("<f8", [2], 1), raw=b"\0" * 8),
    "too many bytes": forged_message(("<f8", [1], 1), raw=b"\0" * 9),
    "too few arrays": forged_message(("<f8", [1], 1), content=(0, 0), raw=b"\0" * 8),
    "too many arrays": forged_message(("<f8", [1], 2), raw=b"\0" * 16),
    "too many of none": forged_message(content=(0,)),
    "an array in its place": forged_message(("<f8", [1], 1), content=[("<f8", [1], b"\0" * 8)], raw=b"\0" * 8),
    "another number in its place": forged_message(("<f8", [1], 1), content=(1,), raw=b"\0" * 8),
    "no dtype": forged_message(("no dtype", [1], 1), raw=b"\0" * 8),
    "objects": forged_message(("|O", [1], 1), raw=b"\0" * 8),
    "this machine's own order of bytes": forged_message(("f8", [1], 1), raw=b"\0" * 8),
    "a size for NumPy to work out": forged_message(("<f8", [-1], 1), raw=b"\0" * 8),
    "no arrays of a kind": forged_message(("<f8", [1], 0), content=()),
    "a boolean that is none": forged_message(("|b1", [2], 1), raw=b"\1\2"),
    "more dimensions than there are": forged_message(("<f8", [1] * 65, 1), raw=b"\0" * 8),
    "sizes beyond all memory": forged_message(("<f8", [2**40, 2**40], 1), raw=b"\0" * 8),
    "sizes beyond all memory, of nothing": forged_message(("<f8", [0, 2**48, 2**48], 2**48)),
    "as many of nothing": forged_message(("<f8", [0], 2**48)),
    "numbers beyond 64 bits": forged_message(("<f8", [2**64 - 1], 2**64 - 1)),
    "a table that is none": forged_message(3),
}


@pytest.mark.parametrize("forged", FORGED.values(), ids=FORGED.keys())
def test_forged_messages_are_value_errors(forged: bytes) -> None:
    with pytest.raises(ValueError, match=r".+"):
        LISTS.decode(forged)
    assert LISTS.decode(codec.pack([np.zeros(1)])) == [0.0]  # the next message is read


def test_claimed_sizes_take_no_memory() -> None:
    tracemalloc.start()
    for kind in (("<f8", [0], 2**48), ("<f8", [2**20, 2**20], 1), ("|u1", [], 2**40)):
        with pytest.raises(ValueError, match=r".+"):
            LISTS.decode(forged_message(kind))
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
