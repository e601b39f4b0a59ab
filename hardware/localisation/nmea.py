"""GPS receivers: NMEA 0183 sentences GGA (position), RMC (date, velocity) and VTG (velocity) from a serial port.

Positions are in the frame of a `TangentPlane`. A receiver sends RMC and GGA for the same measurement: after a first GGA,
positions of RMC are ignored, since they would count twice.
"""

import datetime as dt
import math
from typing import Annotated, Any

import msgspec
import pynmea2  # type: ignore[import-untyped]

from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.types import NonNegative, Positive
from vcmvsp.hardware.drivers.byte_link import ByteLink, open_line
from vcmvsp.hardware.localisation.port_source import PortSource
from vcmvsp.hardware.localisation.source import Advice, Baud, LineReader, Located, WorldTransform

LONGEST_BYTES = 256  # of a line; the standard allows 82
Latitude = Annotated[float, msgspec.Meta(ge=-90, le=90)]  # deg
Longitude = Annotated[float, msgspec.Meta(ge=-180, le=180)]  # deg
KNOT = 1852.0 / 3600.0  # m/s
_UNREADABLE = (pynmea2.ParseError, ValueError, TypeError, AttributeError, ArithmeticError, LookupError)  # of any field


class NmeaReader(LineReader):
    """Decodes the sentences of a receiver.

    Args:
        plane: frame of the positions.
        range_sigma_m: user range error, 1 sigma; with a horizontal dilution h the standard deviation of x and of y is
            h * range_sigma_m / sqrt(2). The default is the signal-in-space range error of GPS, 7.8 m at 95 % [GPS SPS
            Performance Standard, 4th ed. 2008, table 3.4-1]; a receiver with corrections has far less.
    """

    def __init__(self, plane: TangentPlane, range_sigma_m: float = 4.0) -> None:
        super().__init__(self._read, LONGEST_BYTES)
        self.plane, self.range_sigma_m = plane, range_sigma_m
        self._date: dt.datetime | None = None  # of the last RMC
        self._has_gga = False

    def _read(self, line: str) -> Located | None:
        try:
            sentence = pynmea2.parse(line[max(line.rfind("$"), 0) :], check=True)
            match getattr(sentence, "sentence_type", ""):
                case "GGA":
                    return self._gga(sentence)
                case "RMC":
                    return self._rmc(sentence)
                case "VTG":
                    return _vtg(sentence)
        except pynmea2.nmea.SentenceTypeError:
            return None  # a valid sentence of a kind that pynmea2 does not support
        except _UNREADABLE as error:
            raise ValueError("invalid NMEA sentence") from error
        return None

    def _gga(self, sentence: Any) -> Located:
        self._has_gga = True
        when = self._time(sentence.timestamp)
        if not int(sentence.gps_qual or 0):
            return Located(source_ns=when)
        height = float(sentence.altitude or 0.0) + float(sentence.geo_sep or 0.0)  # geoid and ellipsoid
        dilution = float(sentence.horizontal_dil) if sentence.horizontal_dil else 1.0
        return Located(position=self._place(sentence, height), sigma_m=self._sigma(dilution), source_ns=when)

    def _rmc(self, sentence: Any) -> Located:
        if sentence.datestamp is not None and sentence.timestamp is not None:
            self._date = dt.datetime.combine(sentence.datestamp, sentence.timestamp).replace(tzinfo=dt.UTC)
        when = self._time(sentence.timestamp)
        if sentence.status != "A":
            return Located(source_ns=when)
        speed = None if sentence.spd_over_grnd is None else float(sentence.spd_over_grnd) * KNOT
        place = None if self._has_gga else self._place(sentence, self.plane.height_m)
        sigma = None if place is None else self._sigma(1.0)
        return Located(position=place, velocity=_velocity(speed, sentence.true_course), sigma_m=sigma, source_ns=when)

    def _place(self, sentence: Any, height_m: float) -> tuple[float, float, float]:
        if not sentence.lat or not sentence.lon or sentence.lat_dir not in ("N", "S") or sentence.lon_dir not in ("E", "W"):
            raise ValueError("a valid position has both coordinates and their directions")
        latitude, longitude = float(sentence.latitude), float(sentence.longitude)
        if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0 and math.isfinite(height_m)):
            raise ValueError("not a place on the earth")
        return self.plane.enu(latitude, longitude, height_m)

    def _sigma(self, dilution: float) -> float:
        """Standard deviation of x and of y; HDOP is that of both together."""
        if not 0.0 < dilution < math.inf:
            raise ValueError(f"a dilution is positive, not {dilution}")
        return dilution * self.range_sigma_m / math.sqrt(2.0)

    def _time(self, of_day: dt.time | None) -> int | None:
        """UTC as ns since 1970, without leap seconds; None until an RMC gives the date, since GGA has only the time of day."""
        if of_day is None or self._date is None:
            return None
        moment = dt.datetime.combine(self._date.date(), of_day).replace(tzinfo=dt.UTC)
        if (self._date - moment) > dt.timedelta(hours=12):  # midnight has passed since the last RMC
            moment += dt.timedelta(days=1)
        return (moment - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)) // dt.timedelta(microseconds=1) * 1000


def _vtg(sentence: Any) -> Located:
    kmph, knots = sentence.spd_over_grnd_kmph, sentence.spd_over_grnd_kts
    speed = None if knots is None else float(knots) * KNOT
    return Located(velocity=_velocity(speed if kmph is None else float(kmph) / 3.6, sentence.true_track))


def _velocity(speed: float | None, course_deg: Any) -> tuple[float, float] | None:
    """East and north, m/s; the course is clockwise from true north. None if either is missing (at rest)."""
    if speed is None or course_deg is None or course_deg == "":
        return None
    course = math.radians(float(course_deg))
    east, north = speed * math.sin(course), speed * math.cos(course)
    if not (math.isfinite(east) and math.isfinite(north)):
        raise ValueError("no velocity")
    return east, north


class Nmea(PortSource):
    """A receiver of satellite positions on a serial port.

    Args:
        port: such as ``/dev/ttyUSB0``.
        latitude_deg: of the world's origin, WGS 84; its x axis points east.
        longitude_deg: of the world's origin.
        height_m: of the world's origin, above the ellipsoid.
        baud: of the port.
        range_sigma_m: user range error; with the receiver's dilution it gives the standard deviation.
        latency_s: minimum delay from measurement to arrival.
    """

    def __init__(
        self,
        *,
        port: str,
        latitude_deg: Latitude,
        longitude_deg: Longitude,
        height_m: float = 0.0,
        baud: Baud = 4800,
        range_sigma_m: Positive = 4.0,
        latency_s: NonNegative = 0.2,
    ) -> None:
        words = Advice("check that the receiver is on, and its port", "the bytes are not NMEA: check the baud rate")
        reader = NmeaReader(TangentPlane(latitude_deg, longitude_deg, height_m), range_sigma_m)
        transform = WorldTransform(sigma_m=range_sigma_m, latency_s=latency_s)
        super().__init__(port, reader, transform, words)
        self._baud = baud

    def _open_line(self) -> ByteLink:
        return open_line(self.device, self._baud)
