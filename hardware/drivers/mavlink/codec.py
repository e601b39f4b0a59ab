"""MAVLink messages to bytes and back. pymavlink supplies the messages; this module finds them in a stream.

pymavlink's parser skips the announced length of a broken message, and with it valid messages; the connections of its
``mavutil`` print, wait and hide errors, which a driver must not do.
"""

from typing import Any

from pymavlink.dialects.v20 import common as mavlink  # type: ignore[import-untyped]

from vcmvsp.cosim.types import Value

__all__ = ["Encoder", "Message", "MessageReader", "Sender", "mavlink", "sender_of"]

Message = Any  # pymavlink makes a class for each kind of message

# Magic byte: bytes before and after the payload [mavlink.io, packet serialization].
_AROUND = {0xFE: 8, 0xFD: 12}  # MAVLink 1, MAVLink 2
_SIGNATURE = 13  # bytes, behind a signed message
_SIGNED = 0x01  # of the incompatibility flags


class Sender(Value, frozen=True, kw_only=True):
    """Address of a sender."""

    system: int
    component: int


class Encoder:
    """Encodes messages of one sender, with sequence numbers, as MAVLink 2."""

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
    """Finds MAVLink 1 and 2 messages in a stream; messages with a wrong checksum or of unknown type are dropped.

    After a broken message the search continues at the next byte, so that no valid message is lost.

    Attributes:
        messages: number of messages so far.
    """

    def __init__(self) -> None:
        self.messages = 0
        self._mav = mavlink.MAVLink(None)
        self._buffer = bytearray()

    def feed(self, chunk: bytes) -> list[Message]:
        """Messages that these bytes complete."""
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
        if data[0] == 0xFD and data[2] & ~_SIGNED:  # unknown feature: MAVLink requires to drop the message
            return None
        try:
            message = self._mav.decode(data)
        except mavlink.MAVError:
            return None
        return message if type(message) is not mavlink.MAVLink_unknown else None  # its checksum is unknown


def sender_of(message: Message) -> Sender:
    """Sender of a message."""
    return Sender(system=message.get_srcSystem(), component=message.get_srcComponent())
