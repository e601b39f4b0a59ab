"""Where a real vehicle is, from outside: the kinds of ``localisation`` that a scenario can give it.

All of them tell positions in the world on this machine's monotonic clock. Times of measuring come from the system's own clock
where it tells one (`cosim.estimation.clock_offset`), else from the arrival; ``latency_s`` is what lies between measuring and
arriving at least, which no clock can tell. Frames of systems are turned by ``turn_rad`` and then moved by ``offset`` into the
world. What is not finite, or more than 10 km from the world's origin, is refused. Poses over Zenoh are in
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
    """Tells where a vehicle is."""

    device: str  # for messages

    def open(self) -> None:
        """Begin to hear; takes no longer than some seconds.

        Raises:
            PortError: there is nothing to hear at; what to do.
        """

    def read(self, now_ns: int) -> list[Fix]:
        """Readings that are new since the last call, oldest first, none from after ``now_ns``; never waits.

        Raises:
            DriverError: none can come any more, or nobody can say whose.
        """

    def notices(self) -> list[Notice]:
        """What happened since the last call, oldest first: positions come, are lost, and why."""

    def close(self) -> None:
        """Stop hearing, port free. May be called twice, and after a failure."""


class Ubisense(PortSource):
    """Ubisense tags, from datagrams of the location engine ("on the wire" protocol).

    Args:
        listen: where this machine hears them, ``udp://address:port``; 0.0.0.0 is any of its interfaces, and needs ``insecure``.
        insecure: ``listen`` may be all interfaces: whoever reaches one of them can tell positions.
        tag: hexadecimal number of the vehicle's tag; empty: the only one that is heard.
        sigma_m: standard deviation of x and y where a datagram says none.
        latency_s: between measuring and arriving, at least.
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
        placing = WorldTransform(
            tag=_hexadecimal(tag), sigma_m=sigma_m, latency_s=latency_s, offset=offset, turn_rad=turn_rad, normal=_hexadecimal
        )
        self._url = listen
        super().__init__(listen, DatagramReader(ubisense.decode), placing, words, open_line=self._bound)

    def _bound(self) -> ByteLink:
        line = Datagrams(self._url)
        self.device = line.url
        return line


class Dwm1001(PortSource):
    """A Decawave DWM1001 tag, or a listener, on a serial port; it is asked for positions.

    Args:
        port: such as ``/dev/ttyACM0``.
        baud: of the port.
        tag: name of the vehicle's tag, where a listener tells of several; empty: the only one.
        sigma_m: standard deviation of x and y, which it does not tell.
        latency_s: between measuring and arriving.
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
        placing = WorldTransform(tag=tag, sigma_m=sigma_m, latency_s=latency_s, offset=offset, turn_rad=turn_rad)
        self._waker = dwm1001.Waker()

        def opened() -> ByteLink:
            self._waker = dwm1001.Waker()  # who was unplugged has forgotten all
            return open_line(port, baud)

        super().__init__(
            port, LineReader(dwm1001.decode, dwm1001.LONGEST_BYTES), placing, words, open_line=opened, say=self._asked
        )

    def take(self, chunk: bytes, arrived_ns: int) -> bool:
        """Something came; a module that tells positions need not be asked."""
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
        longitude_deg: the same.
        height_m: the same, above the ellipsoid.
        baud: of the port.
        range_sigma_m: user range error; with the receiver's dilution it makes the standard deviation.
        latency_s: between measuring and arriving, at least.
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
        placing = WorldTransform(sigma_m=range_sigma_m, latency_s=latency_s)
        super().__init__(port, reader, placing, words, open_line=lambda: open_line(port, baud))


def _hexadecimal(tag: str) -> str:
    """A tag as 16 hexadecimal digits; empty as it is."""
    return ubisense.tag_of(tag) if tag else ""
