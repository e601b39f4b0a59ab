"""NMEA 0183: sentences of the standard's kind, check sums, dates, any split of the stream."""

import datetime as dt
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.hardware.localisation.nmea import NmeaReader

# The examples that every book has, 48 deg 07.038' N, 11 deg 31.000' E; their check sums are printed with them.
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
    assert located.source_ns is None  # the date is not known yet


def test_rmc_dates_gga_and_tells_velocity() -> None:
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
    assert late.source_ns is not None
    assert after.source_ns - late.source_ns == 500_000_000


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
        GGA.replace(b"*47", b"*48"),  # check sum
        GGA.replace(b"*47", b""),  # none
        GGA.replace(b"4807", b"4808"),  # a digit that flipped
        _sentence("GPGGA,123519,9907.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),  # no such latitude
        _sentence("GPGGA,123519,4807.038,Q,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"),  # no such hemisphere
        _sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,nan,545.4,M,46.9,M,,"),
        _sentence("GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,inf,M,46.9,M,,"),
        _sentence("GPGGA,123519,4807.038,N,,,1,08,0.9,545.4,M,46.9,M,,"),
        _sentence("GPRMC,996099,A,4807.038,N,01131.000,E,022.4,084.4,999999,003.1,W"),
        _sentence("GPVTG,054.7,T,034.4,M,005.5,N,inf,K"),
        b"\xff\xfe\x00$\r\n",
    ],
)
def test_what_cannot_be_read_is_counted(bad: bytes) -> None:
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
