"""What an autopilot says in words: the pieces of a STATUSTEXT become one text again, and errors are told, not all the time."""

from vcmvsp.hardware.drivers.mavlink.codec import Message, mavlink

TEXT = 50  # characters of a STATUSTEXT; a longer text comes in pieces
REPEAT_NS = 10_000_000_000  # the same text is told again after so long


class Texts:
    """Listens to one vehicle.

    Attributes:
        last: the last text that was told; empty: none.
    """

    def __init__(self) -> None:
        self.last = ""
        self._last_ns = -REPEAT_NS
        self._piece: dict[int, str] = {}  # of a text, by its number

    def hear(self, message: Message, now_ns: int) -> str:
        """The text that is to be told now; empty: there is none, for it goes on, tells no error, or was told lately."""
        text = self._piece.pop(message.id, "") + message.text if message.id and message.chunk_seq else message.text
        if message.id and len(message.text) == TEXT:
            self._piece = {message.id: text}
            return ""
        if message.severity > mavlink.MAV_SEVERITY_ERROR or not text.strip():
            return ""
        text = "".join(each if each.isprintable() else "?" for each in text.strip())
        if text == self.last and now_ns - self._last_ns < REPEAT_NS:
            return ""
        self.last, self._last_ns = text, now_ns
        return text
