"""Localisation of a real vehicle from outside: the kinds of ``localisation`` in a scenario.

Positions are in the world, on this machine's monotonic clock. Times of measurement come from the system's own clock if it has
one (`cosim.estimation.clock_offset`), else from the arrival; ``latency_s`` is the minimum delay from measurement to arrival,
which no clock shows. Frames of systems are rotated by ``turn_rad`` and then moved by ``offset`` into the world. Positions that
are not finite, or more than 10 km from the world's origin, are rejected. Poses over Zenoh are in
`hardware.localisation.pose_topic`.
"""

from typing import Annotated, Protocol, runtime_checkable

import msgspec

from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.transport.endpoints import check_interfaces
from vcmvsp.cosim.types import Fix, NonNegative, Positive, Vec3
from vcmvsp.hardware.drivers.base import Notice
from vcmvsp.hardware.drivers.byte_link import ByteLink, open_line
from vcmvsp.hardware.localisation import dwm1001, nmea, ubisense
from vcmvsp.hardware.localisation.datagrams import Datagrams, address
from vcmvsp.hardware.localisation.port_source import PortSource
from vcmvsp.hardware.localisation.readers import DatagramReader, LineReader
from vcmvsp.hardware.localisation.source import Advice
from vcmvsp.hardware.localisation.world_transform import AT_REST, WorldTransform

Baud = Annotated[int, msgspec.Meta(ge=50, le=4_000_000)]
Latitude = Annotated[float, msgspec.Meta(ge=-90, le=90)]  # deg
Longitude = Annotated[float, msgspec.Meta(ge=-180, le=180)]  # deg


@runtime_checkable
class Localisation(Protocol):
    """Positions of a vehicle."""

    device: str  # for messages

    def open(self) -> None:
        """Start receiving; takes some seconds at most.

        Raises:
            PortError: the port or address cannot be opened, and the remedy.
        """

    def read(self, now_ns: int) -> list[Fix]:
        """Readings since the last call, oldest first, none after ``now_ns``; never waits.

        Raises:
            DriverError: no reading can come any more, or their tag is ambiguous.
        """

    def notices(self) -> list[Notice]:
        """Events since the last call, oldest first: positions arrive, are lost, and why."""

    def close(self) -> None:
        """Stop receiving and free the port. May be called twice, and after a failure."""


class Ubisense(PortSource):
    """Ubisense tags, from datagrams of the location engine ("on the wire" protocol).

    Args:
        listen: address of the datagrams, ``udp://address:port``; 0.0.0.0 is any interface, and needs ``insecure``.
        insecure: ``listen`` may be all interfaces: any machine that reaches one of them can send positions.
        tag: hexadecimal number of the vehicle's tag; empty: the only one.
        sigma_m: standard deviation of x and y if a datagram has none.
        latency_s: minimum delay from measurement to arrival.
        offset: of the system's frame in the world, m.
        turn_rad: of its frame in the world.
    """

    def __init__(
        self,
        *,
        listen: str = "udp://127.0.0.1:5010",
        insecure: bool = False,
        tag: str = "",
        sigma_m: Positive = 0.15,
        latency_s: NonNegative = 0.1,
        offset: Vec3 = AT_REST,
        turn_rad: float = 0.0,
    ) -> None:
        check_interfaces(address(listen)[0], insecure=insecure)
        words = Advice(
            f"does the location engine send datagrams to {listen}, and is the tag awake?",
            "datagrams come but none are Ubisense's: does something else send to this port?",
        )
        transform = WorldTransform(
            tag=_hexadecimal(tag), sigma_m=sigma_m, latency_s=latency_s, offset=offset, turn_rad=turn_rad, normal=_hexadecimal
        )
        self._url = listen
        super().__init__(listen, DatagramReader(ubisense.decode), transform, words, open_line=self._bound)

    def _bound(self) -> ByteLink:
        line = Datagrams(self._url)
        self.device = line.url
        return line


class Dwm1001(PortSource):
    """A Decawave DWM1001 tag, or a listener, on a serial port; the driver switches its positions on.

    Args:
        port: such as ``/dev/ttyACM0``.
        baud: of the port.
        tag: name of the vehicle's tag, if a listener reports several; empty: the only one.
        sigma_m: standard deviation of x and y.
        latency_s: delay from measurement to arrival.
        offset: of the system's frame in the world, m.
        turn_rad: of its frame in the world.
    """

    def __init__(
        self,
        *,
        port: str,
        baud: Baud = dwm1001.BAUD,
        tag: str = "",
        sigma_m: Positive = 0.15,
        latency_s: NonNegative = 0.1,
        offset: Vec3 = AT_REST,
        turn_rad: float = 0.0,
    ) -> None:
        words = Advice(
            "is the module on, and is this its port?", "bytes come but none are lines of a DWM1001: wrong port or baud rate?"
        )
        transform = WorldTransform(tag=tag, sigma_m=sigma_m, latency_s=latency_s, offset=offset, turn_rad=turn_rad)
        self._waker = dwm1001.Waker()

        def opened() -> ByteLink:
            self._waker = dwm1001.Waker()  # the module restarts when it is plugged in
            return open_line(port, baud)

        super().__init__(
            port, LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES), transform, words, open_line=opened, say=self._asked
        )

    def take(self, chunk: bytes, arrived_ns: int) -> bool:
        """Decode bytes; a module that sends positions is not switched."""
        has_positions = super().take(chunk, arrived_ns)
        if has_positions:
            self._waker.heard(arrived_ns)
        return has_positions

    def _asked(self, now_ns: int) -> bytes:
        return self._waker.write(now_ns)


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
        words = Advice("is the receiver on, and is this its port?", "bytes come but none are NMEA: wrong baud rate?")
        reader = nmea.NmeaReader(TangentPlane(latitude_deg, longitude_deg, height_m), range_sigma_m)
        transform = WorldTransform(sigma_m=range_sigma_m, latency_s=latency_s)
        super().__init__(port, reader, transform, words, open_line=lambda: open_line(port, baud))


def _hexadecimal(tag: str) -> str:
    """A tag as 16 hexadecimal digits; empty as it is."""
    return ubisense.tag_of(tag) if tag else ""
