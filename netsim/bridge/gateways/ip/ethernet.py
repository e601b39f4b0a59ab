"""Ethernet on the radio: addresses of the vehicles' interfaces, and the receiver of a frame.

A frame of the radio's standard has the addresses and the type of the Ethernet frame in its own header: on the air, only what
follows the Ethernet header is payload.
"""

import ipaddress
from collections.abc import Iterable

HEADER = 14  # bytes: destination 6, source 6, type 2 (IEEE 802.3, 3.2)
VEHICLES, RADIOS = 0xFFFF, 0x100 - 0x6D  # addresses that `mac_of` has

FOREIGN = "from another Ethernet address than the vehicle's"
"""Reason to drop a frame: a station of IEEE 802.11 sends with its own address only."""
NO_RECEIVER = "no such Ethernet address"
NO_FRAME = "not an Ethernet frame"

_PREFIX = b"\x02vc"  # 2: locally administered (IEEE 802, 8.2)


def mac_of(row: int, radio: int = 0) -> bytes:
    """The address of the vehicle in this row, 6 bytes: 02:76:63:6d:00:01 in row 0, 02:76:63:6e:00:01 on its second radio."""
    return _PREFIX + bytes((0x6D + radio,)) + (row + 1).to_bytes(2, "big")


def link_local(mac: bytes) -> str:
    """The IPv6 link-local address of an interface, by its modified EUI-64 (RFC 4291, appendix A)."""
    interface = bytes((mac[0] ^ 0x02,)) + mac[1:3] + b"\xff\xfe" + mac[3:]
    return str(ipaddress.IPv6Address(b"\xfe\x80" + bytes(6) + interface))


class Stations:
    """Vehicle of each Ethernet address: the frame's destination, which is the next hop, decides who receives it.

    ``radio``: number of the radio whose addresses these are.
    """

    header_bytes = HEADER

    def __init__(self, rows: Iterable[int], broadcast: int, radio: int = 0) -> None:
        self._rows = {mac_of(row, radio): row for row in rows}
        self._broadcast, self._radio = broadcast, radio

    def goes_to(self, sender: int, frame: bytes) -> int | str:
        """The row of the destination vehicle, the row ``broadcast``, or the reason to drop the frame."""
        if len(frame) < HEADER:
            return NO_FRAME
        if frame[6:12] != mac_of(sender, self._radio):
            return FOREIGN
        if frame[0] & 1:  # a group address (IEEE 802, 8.2): broadcast and multicast
            return self._broadcast
        row = self._rows.get(frame[:6])
        return NO_RECEIVER if row is None or row == sender else row

    def carries(self, sender: int, payload: bytes) -> bool:
        """Whether the radio of ``sender`` carries this payload as a frame; messages of agents are none."""
        return len(payload) >= HEADER and payload[6:12] == mac_of(sender, self._radio)
