"""What is kept of a recording as its file is read through, since it takes all messages of a topic to know it."""

from collections.abc import Mapping

from vcmvsp.cosim.view.messages import Line
from vcmvsp.cosim.view.player import decoding as values
from vcmvsp.cosim.view.player.frame_counts import Counts
from vcmvsp.cosim.view.player.mcap_index import Taker
from vcmvsp.cosim.view.player.notes import Notes

FRAMES, LOG, HALTED = "radio/frame", "log", "operator/halted"
NOTE = "note"  # of each vehicle
LINES = 200  # of the log, at once


class Kept:
    """Counts of frames, lines of the log, notes, and what the operator did.

    Args:
        about: what the recording says of its run, known before its first message.
    """

    def __init__(self, about: Mapping[str, str]) -> None:
        self._about = about
        self.counts = Counts(())
        self.lines: list[Line] = []
        self.notes: dict[str, Notes] = {}  # by topic
        self._halted: list[tuple[int, tuple[str, ...]]] = []

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Those of the run, in its order."""
        return tuple(self._about.get("vehicles", "").split())

    def taker(self, topic: str) -> Taker | None:
        """What takes all messages of a topic, if they are needed."""
        if topic.partition("/")[2] == NOTE:
            self.notes[topic] = Notes()
            return self.notes[topic].take
        takers = {FRAMES: self._take_frame, LOG: self._take_line, HALTED: self._take_halted}
        return takers.get(topic)

    def close(self) -> None:
        """There are no more."""
        if not self.counts.vehicles:  # there was no frame
            self.counts = Counts(self.vehicles)
        self.counts.close()

    def halted(self, time_ns: int) -> tuple[str, ...]:
        """Whom the operator has stopped."""
        return next((names for when_ns, names in reversed(self._halted) if when_ns <= time_ns), ())

    def said(self, time_ns: int, since_ns: int | None) -> tuple[Line, ...]:
        """The newest lines of the log; ``since_ns``: those that were later."""
        from_ns = -1 if since_ns is None else since_ns
        return tuple(line for line in self.lines if from_ns < line.time_ns <= time_ns)[-LINES:]

    def _take_frame(self, time_ns: int, data: bytes) -> None:
        if not self.counts.vehicles:
            self.counts = Counts(self.vehicles)
        self.counts.take(time_ns, data)

    def _take_line(self, time_ns: int, data: bytes) -> None:
        self.lines.append(values.line_of(data, time_ns))

    def _take_halted(self, time_ns: int, data: bytes) -> None:
        said = values.halted_of(data)
        stand = {name for name in (self._halted[-1][1] if self._halted else ()) if name not in said.vehicles}
        stand |= {*said.vehicles} if said.halted else set()
        self._halted.append((time_ns, tuple(name for name in self.vehicles if name in stand)))
