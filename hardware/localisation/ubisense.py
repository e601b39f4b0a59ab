"""Ubisense: locations of tags in UDP datagrams ("on the wire" protocol).

A datagram has 40 bytes: u16 E298h, u16 026Bh, u64 tag, u32 flags (0: no valid position), float32 x, y, z (m), float32
variance (m2), u64 time (ns) [docs.ubisense.com, D4 Ubisense protocol]. The byte order is that in which the first two
numbers come out right. There is no heading.
"""

import math
import struct
from typing import Literal

from vcmvsp.cosim.transport.endpoints import check_interfaces
from vcmvsp.cosim.types import ORIGIN, NonNegative, Positive, Vec3
from vcmvsp.hardware.drivers.byte_link import ByteLink
from vcmvsp.hardware.localisation.port_source import Datagrams, PortSource, address
from vcmvsp.hardware.localisation.source import Advice, DatagramReader, Located, WorldTransform

MAGIC = (0xE298, 0x026B)
SIZE_BYTES = 40
VALID = 1  # any flags but 0
_FIELDS = "HHQIffffQ"


def tag_of(text: str) -> str:
    """Hexadecimal number of a tag as 16 digits; `ValueError`: the text is no such number."""
    try:
        number = int(text, 16)
    except ValueError:
        number = -1
    if not 0 <= number < 2**64:
        raise ValueError(f"a tag is a hexadecimal number of at most 16 digits, e.g. 11CE0000A1, not '{text}'")
    return f"{number:016X}"


def decode(datagram: bytes) -> Located:
    """Position of a datagram; `ValueError` if it is not of this protocol."""
    if len(datagram) != SIZE_BYTES:
        raise ValueError(f"a datagram has {SIZE_BYTES} bytes, not {len(datagram)}")
    order = next((each for each in ("<", ">") if struct.unpack_from(each + "HH", datagram) == MAGIC), None)
    if order is None:
        raise ValueError(f"a datagram begins with E298 026B, not {datagram[:4].hex(' ', 2)}")
    _, _, tag, flags, x, y, z, variance, time_ns = struct.unpack(order + _FIELDS, datagram)
    if flags and not all(map(math.isfinite, (x, y, z))):
        raise ValueError("a valid position has finite coordinates")
    sigma_m = math.sqrt(variance) if 0.0 < variance < math.inf else None
    return Located(tag=f"{tag:016X}", position=(x, y, z) if flags else None, sigma_m=sigma_m, source_ns=time_ns)


def encode(located: Located, order: Literal["<", ">"] = "<") -> bytes:
    """Datagram of a position, for emulation. The tag is a hexadecimal number."""
    x, y, z = located.position or (0.0, 0.0, 0.0)
    flags = 0 if located.position is None else VALID
    variance = (located.sigma_m or 0.0) ** 2
    tag = int(located.tag or "0", 16)
    return struct.pack(order + _FIELDS, *MAGIC, tag, flags, x, y, z, variance, located.source_ns or 0)


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
        offset: Vec3 = ORIGIN,
        turn_rad: float = 0.0,
    ) -> None:
        check_interfaces(address(listen)[0], insecure=insecure)
        words = Advice(
            f"check that the location engine sends datagrams to {listen}, and that the tag is awake",
            "the datagrams are not Ubisense's: check which program sends to this port",
        )
        transform = WorldTransform(
            tag=tag,
            sigma_m=sigma_m,
            latency_s=latency_s,
            offset=offset,
            turn_rad=turn_rad,
            normal=lambda text: text and tag_of(text),
        )
        self._url = listen
        super().__init__(listen, DatagramReader(decode), transform, words)

    def _open_line(self) -> ByteLink:
        line = Datagrams(self._url)
        self.device = line.url
        return line
