"""Readers of positioning messages: bytes of a port or a socket become `Located`; invalid input is counted, never raised."""

from collections.abc import Callable

from vcmvsp.hardware.localisation import Located


class DatagramReader:
    """Decodes datagrams.

    Args:
        decode: one datagram to one position; `ValueError`: it is not of this protocol.

    Attributes:
        invalid: datagrams or lines so far that could not be decoded.
    """

    def __init__(self, decode: Callable[[bytes], Located]) -> None:
        self._decode, self.invalid = decode, 0

    def feed(self, chunk: bytes) -> list[Located]:
        """The position of one datagram; empty if it is invalid."""
        try:
            return [self._decode(chunk)]
        except (ValueError, OverflowError, RecursionError):
            self.invalid += 1
            return []


class LineReader:
    """Splits a stream of bytes into lines and decodes these.

    Args:
        decode: one line to one position; None: the line is about something else; `ValueError`: it is invalid.
        longest_bytes: longer lines are dropped.

    Attributes:
        invalid: lines so far that could not be decoded.
        other: lines so far about something else.
    """

    def __init__(self, decode: Callable[[str], Located | None], longest_bytes: int) -> None:
        self._decode, self._longest_bytes = decode, longest_bytes
        self.invalid = self.other = 0
        self._rest = b""

    def feed(self, chunk: bytes) -> list[Located]:
        """The positions of the lines that are complete with these bytes, in order."""
        *lines, self._rest = (self._rest + chunk).replace(b"\r", b"\n").split(b"\n")
        if len(self._rest) > self._longest_bytes:
            self._rest = b""
            self.invalid += 1
        positions = []
        for line in filter(None, map(bytes.strip, lines)):
            try:
                located = self._decode(line.decode("ascii"))
            except ValueError:  # includes UnicodeDecodeError
                self.invalid += 1
                continue
            if located is None:
                self.other += 1
            else:
                positions.append(located)
        return positions
