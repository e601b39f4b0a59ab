"""Bytes to MAVLink messages and back. pymavlink supplies the messages; finding them in a stream is done here.

Its own parser skips as many bytes as a broken message claims to have, and with them the good ones that follow; and the
connections of its ``mavutil`` print, wait and hide errors, which a driver that must never wait cannot use.
"""

from typing import Any

from pymavlink.dialects.v20 import common as mavlink  # type: ignore[import-untyped]

from vcmvsp.cosim.types import Value

__all__ = ["Encoder", "Message", "MessageReader", "Sender", "mavlink", "sender_of"]

Message = Any  # pymavlink makes a class for each kind of message

# Magic byte: bytes before and after the payload [mavlink.io, packet serialization].
_AROUND = {0xFE: 8, 0xFD: 12}  # MAVLink 1, MAVLink 2
_SIGNATURE = 13  # bytes, behind a message that is signed
_SIGNED = 0x01  # of the incompatibility flags


class Sender(Value, frozen=True, kw_only=True):
    """Who speaks."""

    system: int
    component: int


class Encoder:
    """Messages of one sender, numbered as they go, as MAVLink 2."""

    def __init__(self, sender: Sender) -> None:
        self._mav = mavlink.MAVLink(None, srcSystem=sender.system, srcComponent=sender.component)

    def __call__(self, *messages: Message) -> bytes:
        """Their bytes."""
        data = b""
        for each in messages:
            data += each.pack(self._mav)
            self._mav.seq = (self._mav.seq + 1) % 256
        return data


class MessageReader:
    """Messages out of a stream of bytes, of MAVLink 1 and 2; what has no right checksum, or is not known, is left out.

    After something broken the next message is looked for from the next byte on, so that nothing good is lost with it.

    Attributes:
        heard: bytes so far.
        messages: so far.
    """

    def __init__(self) -> None:
        self.byte_count = self.messages = 0
        self._mav = mavlink.MAVLink(None)
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> list[Message]:
        """The messages that are complete with this."""
        self.byte_count += len(chunk)
        self._buffer += chunk
        messages, start, buffer = [], 0, self._buffer
        while start < len(buffer):
            around = _AROUND.get(buffer[start])
            if around is None:
                start += 1
                continue
            if len(buffer) - start < 3:
                break
            length = around + buffer[start + 1]
            if buffer[start] == 0xFD and buffer[start + 2] & _SIGNED:
                length += _SIGNATURE
            if len(buffer) - start < length:
                break
            message = self._decode(buffer[start : start + length])
            if message is not None:
                messages.append(message)
            start += length if message is not None else 1
        del buffer[:start]
        self.messages += len(messages)
        return messages

    def _decode(self, data: bytearray) -> Message | None:
        if data[0] == 0xFD and data[2] & ~_SIGNED:  # a feature that is not known: to be dropped, by the rules of MAVLink
            return None
        try:
            message = self._mav.decode(data)
        except mavlink.MAVError:
            return None
        return message if type(message) is not mavlink.MAVLink_unknown else None  # whose checksum cannot be told


def sender_of(message: Message) -> Sender:
    """Who sent it."""
    return Sender(system=message.get_srcSystem(), component=message.get_srcComponent())
