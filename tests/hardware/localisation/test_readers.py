"""Messages of positioning systems: golden bytes, checksums, any split of the stream; garbage is counted and never raises."""

import datetime as dt
import math
import struct
from itertools import pairwise
from typing import Literal

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.hardware.localisation import dwm1001, ubisense
from vcmvsp.hardware.localisation.nmea import NmeaReader
from vcmvsp.hardware.localisation.source import DatagramReader, LineReader, Located

GOLDEN = "E298026B 0011CE0000001234 00000001 3FC00000 C0200000 3F000000 3C23D70A 00000000499602D2".replace(" ", "")


def test_ubisense_golden_bytes_in_network_order() -> None:
    located = ubisense.decode(bytes.fromhex(GOLDEN))
    assert located.tag == "0011CE0000001234"
    assert located.position == (1.5, -2.5, 0.5)
    assert located.sigma_m == pytest.approx(0.1, rel=1e-6)  # variance 0.01
    assert located.source_ns == 1234567890
    assert ubisense.encode(located, ">") == bytes.fromhex(GOLDEN)


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


def test_ubisense_other_sizes_and_a_position_that_is_not_finite_are_refused() -> None:
    reader, golden = DatagramReader(ubisense.decode), bytes.fromhex(GOLDEN)
    for wrong in (golden[:-1], golden + b"\0", b"", golden[:16] + struct.pack(">f", math.nan) + golden[20:]):
        assert reader.feed(wrong) == []
    assert reader.invalid == 4


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
def test_dwm1001_garbage_never_raises_nor_hides_later_lines(chunks: list[bytes]) -> None:
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
)  # resolution of a line: centimetres and per cent
def test_dwm1001_round_trip(cm: tuple[int, int, int], percent: int, index: int | None) -> None:
    position = (cm[0] / 100, cm[1] / 100, cm[2] / 100)
    report = Located(tag="" if index is None else "4F8B", position=position, quality=percent / 100)
    assert LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES).feed(dwm1001.encode(report, index)) == [report]


def test_dwm1001_tag_without_position_round_trip() -> None:
    assert LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES).feed(dwm1001.encode(Located())) == [Located(quality=0.0)]


S = 1_000_000_000


def _positions_read(tag: dwm1001.Tag, waker: dwm1001.Waker, seconds: int) -> int:
    """Number of positions read from a tag that measures once a second; the host reads four times a second."""
    reader, count = LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES), 0
    for quarter in range(4 * seconds):
        now_ns = quarter * S // 4
        chunk = tag.receive(waker.write(now_ns))
        if quarter % 4 == 3:
            chunk += tag.say(Located(position=(1.0, 2.0, 0.0), quality=0.9))
        if found := [each for each in reader.feed(chunk) if each.position]:
            waker.position_arrived(now_ns)
            count += len(found)
    return count


def test_a_sleeping_tag_is_woken_and_an_active_one_is_not() -> None:
    tag = dwm1001.Tag()
    assert _positions_read(tag, dwm1001.Waker(), 20) >= 16
    assert tag.telling  # a second `lep` would have switched it off
    talking = dwm1001.Tag()
    talking.shell = talking.telling = True
    assert _positions_read(talking, dwm1001.Waker(), 20) == 20
    left = dwm1001.Tag()
    left.telling = True  # `quit` during reports: they resume as soon as the shell opens
    assert _positions_read(left, dwm1001.Waker(), 20) >= 16


def test_the_waker_backs_off_for_rare_reports() -> None:
    waker = dwm1001.Waker(2.0)
    written = [now for now in range(100) if waker.write(now * S) == dwm1001.POSITIONS]
    gaps = [b - a for a, b in pairwise(written)]
    assert gaps == [5, 9, 17, 33]  # waits of 4, 8, 16, 32 s, plus one for the shell


# Textbook sentences, 48 deg 07.038' N, 11 deg 31.000' E, with their published checksums.
GGA = b"$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\r\n"
RMC = b"$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\r\n"
VTG = b"$GPVTG,054.7,T,034.4,M,005.5,N,010.2,K*48\r\n"
LAT, LON, HEIGHT = 48.0 + 7.038 / 60.0, 11.0 + 31.0 / 60.0, 545.4 + 46.9


def _reader() -> NmeaReader:
    return NmeaReader(TangentPlane(LAT, LON, HEIGHT), range_sigma_m=4.0)


def _sentence(body: str) -> bytes:
    check = 0
    for byte in body.encode():
        check ^= byte
    return f"${body}*{check:02X}\r\n".encode()


def test_gga_is_a_position_above_the_ellipsoid() -> None:
    (located,) = _reader().feed(GGA)
    assert located.position == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)
    assert located.sigma_m == pytest.approx(0.9 * 4.0 / math.sqrt(2.0))
    assert located.source_ns is None  # date still unknown


def test_rmc_dates_gga_and_has_velocity() -> None:
    reader = _reader()
    velocity, position = reader.feed(RMC + GGA)
    assert velocity.velocity is not None
    assert math.hypot(*velocity.velocity) == pytest.approx(22.4 * 0.514444, rel=1e-5)
    assert math.degrees(math.atan2(*velocity.velocity)) == pytest.approx(84.4)
    when = int(dt.datetime(1994, 3, 23, 12, 35, 19, tzinfo=dt.UTC).timestamp()) * 1_000_000_000
    assert velocity.source_ns == position.source_ns == when


def test_rmc_gives_positions_only_to_receivers_without_gga() -> None:
    reader = _reader()
    (alone,) = reader.feed(RMC)
    assert alone.position == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert [each.position is None for each in reader.feed(GGA + RMC)] == [False, True]


def test_vtg_is_a_velocity() -> None:
    (located,) = _reader().feed(VTG)
    assert located.velocity == pytest.approx(
        (10.2 / 3.6 * math.sin(math.radians(54.7)), 10.2 / 3.6 * math.cos(math.radians(54.7)))
    )
    assert located.position is None


def test_gga_after_midnight_is_of_the_next_day() -> None:
    reader = _reader()
    reader.feed(_sentence("GPRMC,235959.50,A,4807.038,N,01131.000,E,,,311225,,,A"))
    (after,) = reader.feed(_sentence("GPGGA,000000.25,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"))
    assert after.source_ns == int(dt.datetime(2026, 1, 1, tzinfo=dt.UTC).timestamp()) * 10**9 + 250_000_000
    (late,) = reader.feed(_sentence("GPGGA,235959.75,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"))
    assert after.source_ns - (late.source_ns or 0) == 500_000_000


def test_no_fix_has_no_position() -> None:
    reader = _reader()
    without = reader.feed(_sentence("GPGGA,123519,,,,,0,00,99.99,,,,,,") + _sentence("GNRMC,123519,V,,,,,,,230394,,,N"))
    assert [(each.position, each.velocity) for each in without] == [(None, None)] * 2
    assert reader.invalid == 0


def test_southern_and_western_hemispheres_and_other_talkers() -> None:
    reader = NmeaReader(TangentPlane(-33.5, -70.5, 0.0))
    (located,) = reader.feed(_sentence("GNGGA,010203,3330.000,S,07030.000,W,4,12,1.0,0.0,M,0.0,M,,"))
    assert located.position == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize(
    "bad",
    [
        GGA.replace(b"*47", b"*48"),  # wrong checksum
        GGA.replace(b"*47", b""),  # no checksum
        GGA.replace(b"4807", b"4808"),  # a changed digit
        _sentence("GPGGA,123519,9907.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),  # invalid latitude
        _sentence("GPGGA,123519,4807.038,Q,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),  # invalid hemisphere
        _sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,nan,545.4,M,46.9,M,,"),
        _sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,inf,M,46.9,M,,"),
        _sentence("GPGGA,123519,4807.038,N,,,1,08,0.9,545.4,M,46.9,M,,"),
        _sentence("GPRMC,996099,A,4807.038,N,01131.000,E,022.4,084.4,999999,003.1,W"),
        _sentence("GPVTG,054.7,T,034.4,M,005.5,N,inf,K"),
        b"\xff\xfe\x00$\r\n",
    ],
)
def test_unreadable_lines_are_counted(bad: bytes) -> None:
    reader = _reader()
    assert reader.feed(bad) == []
    assert reader.invalid == 1
    assert len(reader.feed(GGA)) == 1


def test_other_sentences_are_counted_apart() -> None:
    reader = _reader()
    assert (
        reader.feed(_sentence("GPGSA,A,3,04,05,,09,12,,,24,,,,,2.5,1.3,2.1") + _sentence("GPXYZ,1") + _sentence("PUBX,00"))
        == []
    )
    assert (reader.invalid, reader.other) == (0, 3)


@given(st.lists(st.binary(max_size=80)), st.text(alphabet="GPRMCA,0123456789.NEWSV-*", max_size=60))
def test_garbage_never_raises(chunks: list[bytes], body: str) -> None:
    reader = _reader()
    for chunk in chunks:
        reader.feed(chunk)
    for kind in ("GPGGA,", "GPRMC,", "GPVTG,", ""):
        reader.feed(_sentence(kind + body))
    assert reader.feed(b"\r\n" + GGA)[-1].position is not None
