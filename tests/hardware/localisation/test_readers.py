"""Ubisense datagrams and DWM1001 lines: golden bytes, any split of the stream, garbage counted and never raised."""

import math
import struct
from itertools import pairwise
from typing import Literal

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vcmvsp.hardware.localisation import Located, dwm1001, ubisense
from vcmvsp.hardware.localisation.readers import DatagramReader, LineReader

GOLDEN = "E298026B 0011CE0000001234 00000001 3FC00000 C0200000 3F000000 3C23D70A 00000000499602D2".replace(" ", "")


def test_ubisense_golden_bytes_in_network_order() -> None:
    located = ubisense.decode(bytes.fromhex(GOLDEN))
    assert located.tag == "0011CE0000001234"
    assert located.position == (1.5, -2.5, 0.5)
    assert located.sigma_m == pytest.approx(0.1, rel=1e-6)  # variance 0.01
    assert located.source_ns == 1234567890
    assert ubisense.encode(located, ">") == bytes.fromhex(GOLDEN)


def test_ubisense_byte_order_is_told_by_the_magic() -> None:
    big = bytes.fromhex(GOLDEN)
    little = struct.pack("<HHQIffffQ", *struct.unpack(">HHQIffffQ", big))
    assert little[:4] == bytes.fromhex("98E26B02")
    assert ubisense.decode(little) == ubisense.decode(big)


def test_ubisense_flags_zero_has_no_position() -> None:
    datagram = bytearray(bytes.fromhex(GOLDEN))
    datagram[12:16] = bytes(4)
    located = ubisense.decode(bytes(datagram))
    assert located.position is None


@given(
    st.integers(0, 2**64 - 1),
    st.none() | st.tuples(*[st.floats(-1e6, 1e6, width=32)] * 3),
    st.integers(0, 2**64 - 1),
    st.sampled_from(["<", ">"]),
)
def test_ubisense_round_trip(
    tag: int, position: tuple[float, float, float] | None, time_ns: int, order: Literal["<", ">"]
) -> None:
    located = Located(tag=f"{tag:016X}", position=position, source_ns=time_ns)
    assert ubisense.decode(ubisense.encode(located, order)) == located


@given(st.binary(max_size=60) | st.binary(min_size=36, max_size=36).map(lambda rest: bytes.fromhex("E298026B") + rest))
def test_ubisense_garbage_is_counted(datagram: bytes) -> None:
    reader = DatagramReader(ubisense.decode)
    found = reader.feed(datagram)
    assert len(found) + reader.invalid == 1
    for located in found:
        assert located.position is None or all(map(math.isfinite, located.position))


def test_ubisense_a_valid_position_is_finite() -> None:
    datagram = bytearray(bytes.fromhex(GOLDEN))
    datagram[16:20] = struct.pack(">f", math.nan)
    reader = DatagramReader(ubisense.decode)
    assert reader.feed(bytes(datagram)) == []
    assert reader.invalid == 1


def test_ubisense_other_sizes_are_refused() -> None:
    reader = DatagramReader(ubisense.decode)
    assert reader.feed(bytes.fromhex(GOLDEN)[:-1]) == reader.feed(bytes.fromhex(GOLDEN) + b"\0") == reader.feed(b"") == []
    assert reader.invalid == 3


STREAM = (
    b"\r\n DWM1001 TWR Real Time Location System\r\n\r\ndwm> lep\r\ndwm> "
    b"POS,2.57,-1.98,1.68,100\r\n"
    b"DIST,4,AN0,151C,0.00,0.00,0.00,3.44,AN1,0CA8,2.60,0.00,0.00,3.18,POS,2.57,1.98,1.68,97\r\n"
    b"POS,0,4F8B,0.10,0.20,0.30,54,x0D\r\n"
    b"POS,nan,nan,nan,0\r\n"
    b"POS,1.0,2.0\r\n"
    b"POS,1.0,2.0,x,50\r\n"
    b"\xff\xfePOS,1,2,3,4\r\n"
)


def _expected() -> list[Located]:
    return [
        Located(position=(2.57, -1.98, 1.68), quality=1.0),
        Located(position=(2.57, 1.98, 1.68), quality=0.97),
        Located(tag="4F8B", position=(0.1, 0.2, 0.3), quality=0.54),
        Located(position=None, quality=0.0),
    ]


@given(st.lists(st.integers(0, len(STREAM)), max_size=20))
@example([])
def test_dwm1001_reads_any_split_of_the_stream(cuts: list[int]) -> None:
    edges = [0, *sorted(cuts), len(STREAM)]
    reader = LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES)
    found = [each for a, b in pairwise(edges) for each in reader.feed(STREAM[a:b])]
    assert found == _expected()
    assert (reader.invalid, reader.other) == (3, 2)  # others: banner, echo


@given(st.lists(st.binary(max_size=80)))
def test_dwm1001_garbage_never_raises_and_never_hides_what_follows(chunks: list[bytes]) -> None:
    reader = LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES)
    for chunk in chunks:
        reader.feed(chunk)
    assert reader.feed(b"\r\nPOS,1.00,2.00,3.00,50\r\n")[-1].position == (1.0, 2.0, 3.0)


def test_dwm1001_a_line_without_end_is_dropped() -> None:
    reader = LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES)
    for _ in range(1000):
        reader.feed(b"A" * 100)
    assert len(reader._rest) <= dwm1001.LONGEST_BYTES
    assert reader.invalid > 0


@given(
    st.tuples(*[st.integers(-100_000, 100_000)] * 3), st.integers(1, 100), st.none() | st.integers(0, 15)
)  # centimetres and per cent are what a line tells
def test_dwm1001_round_trip(cm: tuple[int, int, int], percent: int, index: int | None) -> None:
    position = (cm[0] / 100, cm[1] / 100, cm[2] / 100)
    said = Located(tag="" if index is None else "4F8B", position=position, quality=percent / 100)
    assert LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES).feed(dwm1001.encode(said, index)) == [said]


def test_dwm1001_tag_without_position_round_trip() -> None:
    assert LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES).feed(dwm1001.encode(Located())) == [Located(quality=0.0)]


S = 1_000_000_000


def _until_it_talks(tag: dwm1001.Tag, waker: dwm1001.Waker, seconds: int) -> int:
    """Positions that were heard, of a tag that measures once a second; the host looks four times a second."""
    reader, heard = LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES), 0
    for quarter in range(4 * seconds):
        now_ns = quarter * S // 4
        chunk = tag.receive(waker.write(now_ns))
        if quarter % 4 == 3:
            chunk += tag.say(Located(position=(1.0, 2.0, 0.0), quality=0.9))
        if found := [each for each in reader.feed(chunk) if each.position]:
            waker.heard(now_ns)
            heard += len(found)
    return heard


def test_a_sleeping_tag_is_woken_and_a_talking_tag_is_left_alone() -> None:
    tag = dwm1001.Tag()
    assert _until_it_talks(tag, dwm1001.Waker(), 20) >= 16
    assert tag.telling  # a second `lep` would have switched it off
    talking = dwm1001.Tag()
    talking.shell = talking.telling = True
    assert _until_it_talks(talking, dwm1001.Waker(), 20) == 20
    left = dwm1001.Tag()
    left.telling = True  # `quit` while it told positions: it goes on as soon as the shell opens
    assert _until_it_talks(left, dwm1001.Waker(), 20) >= 16


def test_the_waker_grows_patient_with_a_tag_that_reports_rarely() -> None:
    waker = dwm1001.Waker(2.0)
    written = [now for now in range(100) if waker.write(now * S) == dwm1001.POSITIONS]
    gaps = [b - a for a, b in pairwise(written)]
    assert gaps == [5, 9, 17, 33]  # 4, 8, 16, 32 s of patience, and one for the shell
