"""Messages between programs and runs: whole for every cut of the stream, and nothing else."""

import contextlib
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.sockets.messages import (
    DEFAULT,
    LARGEST,
    LONGEST_NS,
    MOST_DOWN,
    MOST_UP,
    ROOM,
    Down,
    Frames,
    Go,
    Hello,
    Over,
    Refused,
    Send,
    Up,
    Wait,
    Welcome,
    WireError,
    down,
    framed,
    parsed,
    up,
)

NAMES = st.text(max_size=256)
UPS = st.one_of(
    st.builds(Hello, st.integers(0, 99), NAMES),
    st.builds(Send, st.none() | NAMES, st.binary(max_size=300)),
    st.builds(
        lambda for_ns, hears, held: Wait(for_ns, hears=hears, held=held),
        st.none() | st.integers(1, LONGEST_NS),
        st.booleans(),
        st.integers(0, ROOM),
    ),
)
NUMBERS = st.floats(allow_nan=False)
DOWNS = st.one_of(
    st.builds(Welcome, st.text(), st.lists(st.text()).map(tuple)),
    st.builds(Refused, st.text()),
    st.builds(
        Go, st.integers(0, 2**63), st.none() | st.tuples(NUMBERS, NUMBERS, NUMBERS), st.lists(st.tuples(st.binary(), st.text()))
    ),
    st.builds(Over),
)


def messages_of(frames: Frames) -> list[bytes]:
    found = []
    while (message := frames.next()) is not None:
        found.append(message)
    return found


@given(st.lists(UPS | DOWNS, max_size=6), st.lists(st.integers(1, 40), max_size=30))
def test_messages_are_whole_for_any_cut(messages: list[Any], cuts: list[int]) -> None:
    rest, frames, came = b"".join(map(framed, messages)), Frames(MOST_DOWN), []
    for cut in [*cuts, len(rest)]:
        piece, rest = rest[:cut], rest[cut:]
        frames.feed(piece)
        came += messages_of(frames)
    assert not frames
    read = [down if isinstance(sent, Down) else up for sent in messages]
    assert [decode(message) for decode, message in zip(read, came, strict=True)] == messages


@given(st.binary(max_size=200))
def test_noise_is_a_message_or_an_error(noise: bytes) -> None:
    for read, kinds in ((up, Up), (down, Down)):
        try:
            assert isinstance(read(noise), kinds)
        except WireError as error:
            assert str(error)  # noqa: PT017  some noise is a message


@given(UPS, st.data())
def test_damage_is_a_message_or_an_error(word: Any, data: st.DataObject) -> None:
    content = bytearray(framed(word)[4:])
    content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(WireError):
        assert isinstance(up(bytes(content)), Up)


def test_lengths_are_bounded_before_anything_is_kept() -> None:
    assert len(framed(Send("x" * 256, bytes(LARGEST)))) <= MOST_UP
    full = [(b"", "x" * 60)] * (ROOM // 512)
    assert len(framed(Go(2**62, (1.0, 1.0, 1.0), full))) <= MOST_DOWN
    frames = Frames(MOST_UP)
    frames.feed((MOST_UP + 1).to_bytes(4, "big"))
    with pytest.raises(WireError, match=r"a message of 66560 bytes \(at most 66559\)"):
        frames.next()


@pytest.mark.parametrize(
    "word",
    [
        Wait(0, hears=True, held=0),
        Wait(LONGEST_NS + 1, hears=True, held=0),
        Wait(None, hears=True, held=-1),
        Send(None, bytes(LARGEST + 1)),
        Hello(1, "x" * 257),
    ],
)
def test_values_out_of_bounds_are_refused(word: Any) -> None:
    with pytest.raises(WireError, match="Expected"):
        up(msgspec.msgpack.encode(word))


def test_endpoints() -> None:
    assert parsed(DEFAULT) == ("127.0.0.1", 7550)
    assert parsed("tcp/[::1]:0") == ("::1", 0)
    assert parsed("tcp/localhost:65535") == ("localhost", 65535)
    assert parsed("unix//tmp/s") == "/tmp/s"
    assert parsed("unix/s") == "s"
    for bad in (
        "",
        "tcp/",
        "tcp/h",
        "tcp/h:",
        "tcp/h:65536",
        "tcp/h:-1",
        "tcp/h:٣",
        "udp/h:1",
        "unix/",
        "unix/a\0b",
        "tcp/a b:1",
    ):
        with pytest.raises(ValueError, match="must be tcp/HOST:PORT or unix/PATH"):
            parsed(bad)
