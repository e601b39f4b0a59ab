"""Frames of the protocol: ``FA FB``, a count, that many bytes of data and checksum; a stream of bytes on both sides.

Nothing is acknowledged and nothing sent again: a packet whose checksum is wrong is dropped by whoever reads it. Integers in the
data are little-endian, the checksum is big-endian. Source: Pioneer 2 operations manual, "Communications packets".
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

    A string comes as bytes, and so does whatever begins with no known type of argument.

    Raises:
        ValueError: the data are empty, or the argument is shorter or longer than its type says.
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
    """Finds the packets in a stream of bytes, whatever was lost, flipped or split.

    Reading goes from left to right. Where a header announces a packet whose checksum is right, the packet is taken and reading
    goes on behind it; where the checksum is wrong, reading goes on behind the header's first byte, so that a packet which
    begins inside a falsely announced one is still found, once the announced bytes have come (at most `MAX_BYTES`). A packet
    is therefore lost only if it overlaps false bytes that look like a packet with the right checksum: noise does so with
    probability 2**-16 per announced packet, which is some 2e-10 per byte. Every change of one bit of data or checksum is
    noticed.

    Attributes:
        dropped_bytes: bytes so far that belong to no valid packet.
        bad_checksums: packets so far that were announced and whose checksum was wrong.
    """

    def __init__(self) -> None:
        self.dropped_bytes = 0
        self.bad_checksums = 0
        self._buffer = bytearray()

    @property
    def waiting(self) -> int:
        """How many bytes are kept that may be the beginning of a packet."""
        return len(self._buffer)

    def feed(self, chunk: bytes) -> list[bytes]:
        """Take bytes; the data parts of the packets which they complete."""
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
        """Stop waiting for the rest of an announced packet; the data parts of the packets found behind its header.

        For a line that has been silent for longer than the gaps inside a packet: without it, a false header could hold
        back the next commands, up to `MAX_BYTES` of them.
        """
        packets: list[bytes] = []
        while self._buffer:
            del self._buffer[0]
            self.dropped_bytes += 1
            packets += self.feed(b"")
        return packets

    def _next_header(self, start: int) -> int:
        """Where the next possible header begins: it may be cut off at the end; the length of the buffer if there is none."""
        buffer = self._buffer
        while (start := buffer.find(0xFA, start)) >= 0:
            rest = buffer[start : start + 3]
            if rest[: len(HEADER)] == HEADER[: len(rest)] and (len(rest) < 3 or MIN_BYTES <= rest[2] <= MAX_BYTES):
                return start
            start += 1
        return len(buffer)
