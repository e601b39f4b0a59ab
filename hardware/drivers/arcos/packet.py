"""ARCOS frames in both directions: ``FA FB``, a count, that many bytes of data and checksum.

Frames are not acknowledged and not repeated: the receiver drops packets with a wrong checksum. Integers in the data are
little-endian, the checksum is big-endian. Source: Pioneer 2 operations manual, "Communications packets".
"""

import struct

HEADER = b"\xfa\xfb"
MAX_BYTES = 200  # greatest count: data and checksum
MIN_BYTES = 3  # least count: one byte of data and the checksum

POSITIVE, NEGATIVE, STRING = 0x3B, 0x1B, 0x2B  # types of an argument


def checksum(data: bytes) -> int:
    """Sum of big-endian pairs modulo 2**16; an odd last byte is XORed into the low byte."""
    even = len(data) & ~1
    total: int = sum(struct.unpack(f">{even // 2}H", data[:even])) & 0xFFFF
    return total ^ data[-1] if len(data) & 1 else total


def frame(data: bytes) -> bytes:
    """Header, count, data, checksum."""
    count = len(data) + 2
    if not MIN_BYTES <= count <= MAX_BYTES:
        raise ValueError(f"a packet holds 1 to {MAX_BYTES - 2} bytes of data, not {len(data)}")
    return HEADER + bytes((count,)) + data + checksum(data).to_bytes(2, "big")


def command(number: int, argument: int | str | bytes | None = None) -> bytes:
    """A framed command of a client.

    An int (-32768 to 65535) is sent as its absolute value in 16 bits behind the type byte of its sign, a str (up to 195
    characters, Latin-1) behind its length. Bytes are appended as they are.
    """
    if not 0 <= number <= 0xFF:
        raise ValueError(f"a command is a number from 0 to 255, not {number}")
    data = bytes((number,))
    if isinstance(argument, bytes):
        data += argument
    elif isinstance(argument, str):
        text = argument.encode("latin-1")
        if len(text) > MAX_BYTES - 5:
            raise ValueError(f"a command's text has at most {MAX_BYTES - 5} characters, not {len(text)}")
        data += bytes((STRING, len(text))) + text
    elif argument is not None:
        if not -0x8000 <= argument <= 0xFFFF:
            raise ValueError(f"a command's number is from -32768 to 65535, not {argument}")
        data += struct.pack("<BH", POSITIVE if argument >= 0 else NEGATIVE, abs(argument))
    return frame(data)


def parse_command(data: bytes) -> tuple[int, int | bytes | None]:
    """Number and argument of a command's data part, as the robot reads it.

    The argument is bytes for a string and for an unknown type.

    Raises:
        ValueError: the data are empty, or the length of the argument does not match its type.
    """
    if not data:
        raise ValueError("an empty packet is no command")
    number, rest = data[0], data[1:]
    if not rest:
        return number, None
    kind, value = rest[0], rest[1:]
    if kind in (POSITIVE, NEGATIVE):
        if len(value) != 2:
            raise ValueError(f"command {number}: an integer has 2 bytes, not {len(value)}")
        amount = int.from_bytes(value, "little")
        return number, amount if kind == POSITIVE else -amount
    if kind == STRING:
        if not value or value[0] != len(value) - 1:
            raise ValueError(f"command {number}: the length of its text does not match")
        return number, value[1:]
    return number, rest


class PacketReader:
    """Finds packets in a stream of bytes with lost, changed or split parts.

    If a header announces a packet with a valid checksum, the packet is taken and reading continues behind it; otherwise reading
    continues behind the header's first byte, so that a packet inside a false one is still found, once the announced bytes have
    come (at most `MAX_BYTES`). A packet is therefore lost only if it overlaps false bytes that look like a packet with a valid
    checksum: probability 2**-16 per announced packet, some 2e-10 per byte of noise. Every change of one bit of data or checksum
    is detected.

    Attributes:
        dropped_bytes: bytes so far outside valid packets.
        bad_checksums: packets so far with a wrong checksum.
    """

    def __init__(self) -> None:
        self.dropped_bytes = 0
        self.bad_checksums = 0
        self._buffer = bytearray()

    @property
    def waiting(self) -> int:
        """Number of bytes that may be the start of a packet."""
        return len(self._buffer)

    def feed(self, chunk: bytes) -> list[bytes]:
        """Data parts of the packets that these bytes complete."""
        self._buffer += chunk
        packets = []
        start = 0
        while True:
            header = self._next_header(start)
            self.dropped_bytes += header - start
            start = header
            if start + 3 > len(self._buffer):
                break
            end = start + 3 + self._buffer[start + 2]
            if end > len(self._buffer):
                break
            data = bytes(self._buffer[start + 3 : end - 2])
            if checksum(data) == int.from_bytes(self._buffer[end - 2 : end], "big"):
                packets.append(data)
                start = end
            else:
                self.bad_checksums += 1
                self.dropped_bytes += 1
                start += 1
        del self._buffer[:start]
        return packets

    def give_up(self) -> list[bytes]:
        """Stop waiting for the rest of an announced packet; data parts of the packets behind its header.

        For a link that is silent for longer than the gaps in a packet: a false header could otherwise hold back up to
        `MAX_BYTES` of commands.
        """
        packets: list[bytes] = []
        while self._buffer:
            del self._buffer[0]
            self.dropped_bytes += 1
            packets += self.feed(b"")
        return packets

    def _next_header(self, start: int) -> int:
        """Index of the next possible header, which may be cut off; length of the buffer if there is none."""
        buffer = self._buffer
        while (start := buffer.find(0xFA, start)) >= 0:
            rest = buffer[start : start + 3]
            if rest[: len(HEADER)] == HEADER[: len(rest)] and (len(rest) < 3 or MIN_BYTES <= rest[2] <= MAX_BYTES):
                return start
            start += 1
        return len(buffer)
