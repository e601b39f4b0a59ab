"""Common part of all sources of positions: readings wait until the caller takes them, and silence is reported with its cause.

The thread that receives something passes it to `PositionSource.take` at once, so that it is stamped on arrival.
"""

import threading
import time
from collections import deque
from typing import Literal, NamedTuple

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import words_of
from vcmvsp.cosim.types import Fix
from vcmvsp.hardware.drivers.base import DriverError, HandshakeError, Notice
from vcmvsp.hardware.localisation.readers import DatagramReader, LineReader
from vcmvsp.hardware.localisation.world_transform import FARTHEST_M, OLDEST_S, WorldTransform

PATIENCE_S = 5.0  # without a position before a warning
CENSUS_S = 1.0  # of listening, before a single tag counts as the only one
_MOST_WAITING = 1000  # readings, if the caller takes none
_MOST_TAGS = 8  # that a message lists


class Advice(NamedTuple):
    """Texts of a source's warnings."""

    nothing: str  # remedy if nothing arrives
    unreadable: str  # remedy if only invalid messages arrive


class PositionSource:
    """A source of positions without its port: see `hardware.localisation.systems.Localisation`."""

    def __init__(self, device: str, reader: DatagramReader | LineReader, transform: WorldTransform, words: Advice) -> None:
        self.device = device
        self._reader, self._transform, self._words = reader, transform, words
        self._lock = threading.Lock()
        self._fixes: deque[Fix] = deque(maxlen=_MOST_WAITING)
        self._notices: list[Notice] = []
        self._failure: Exception | None = None
        self._first_tag_ns: int | None = None
        self._begin()

    def read(self, now_ns: int) -> list[Fix]:
        """Readings since the last call, oldest first; never waits.

        Raises:
            DriverError: no reading can come any more, or their tag is ambiguous.
        """
        with self._lock:
            if self._failure is not None:
                raise self._failure
            self._look(now_ns)
            fixes = [each for each in self._fixes if each.time_ns <= now_ns]
            later = [each for each in self._fixes if each.time_ns > now_ns]  # after the caller's time
            self._fixes.clear()
            self._fixes.extend(later)
            return fixes

    def notices(self) -> list[Notice]:
        """What happened since the last call, oldest first."""
        with self._lock:
            notices, self._notices = self._notices, []
        return notices

    def take(self, chunk: bytes, arrived_ns: int) -> bool:
        """Decode bytes; whether they contain a position."""
        with self._lock:
            self._bytes += len(chunk)
            answers = self._reader.feed(chunk)
            for located in answers:
                self._told += 1
                jumps = self._transform.jumps
                fix = self._transform.place(located, arrived_ns)
                if self._transform.jumps > jumps:
                    self._notice("warned", "the clock that stamps the positions has jumped; their times are estimated anew")
                if fix is not None and self._is_ours(arrived_ns):
                    self._fixes.append(fix)
                    self._good(arrived_ns)
            return bool(answers)

    def lost(self, cause: str) -> None:
        """The port is lost."""
        with self._lock:
            self._notice("lost", cause)
            self._gone = self._silent = True

    def back(self) -> None:
        """The port is open again."""
        with self._lock:
            self._expect()

    def failed(self, error: Exception) -> None:
        """No reading will come any more."""
        with self._lock:
            self._failure = error

    def _begin(self) -> None:
        """Reset everything."""
        self._failure = self._first_tag_ns = None
        self._transform.tags.clear()
        self._silent = True  # until the first position, which is reported
        self._fixes.clear()
        self._expect()

    def _expect(self) -> None:
        """Messages should come from now on."""
        self._gone, self._told_why = False, ""
        self._since_ns = time.monotonic_ns()
        self._zero()

    def _zero(self) -> None:
        """Reset the counts of rejected messages."""
        self._bytes = self._told = 0
        transform = self._transform
        transform.unknown = transform.far = transform.old = transform.others = 0

    def _good(self, now_ns: int) -> None:
        if self._silent:
            tag = f" of tag {self._transform.tag}" if self._transform.tag else ""
            self._notice("connected", f"positions{tag} come")
        self._silent, self._told_why, self._since_ns = False, "", now_ns
        self._zero()

    def _is_ours(self, now_ns: int) -> bool:
        """Whether a position is the vehicle's: without a tag name there must be one tag only."""
        transform = self._transform
        if transform.tag or not transform.tags:
            return True
        if self._first_tag_ns is None:
            self._first_tag_ns = now_ns
        waited = now_ns - self._first_tag_ns >= CENSUS_S * SECOND_NS
        if waited and len(transform.tags) > 1 and self._failure is None:
            self._failure = HandshakeError(
                self.device,
                f"positions of {len(transform.tags)} tags come: {_listed(transform.tags)}",
                "name the vehicle's: tag = ...",
            )
        return waited and len(transform.tags) == 1

    def _look(self, now_ns: int) -> None:
        """Warn when positions stay away, and again for each new reason."""
        if self._gone or now_ns - self._since_ns <= PATIENCE_S * SECOND_NS:
            return
        why = self._why()
        if why != self._told_why:
            self._notice("warned", f"no position for {PATIENCE_S:g} s: {why}")
            self._told_why, self._silent = why, True

    def _why(self) -> str:
        transform = self._transform
        if not self._bytes:
            return f"nothing comes; {self._words.nothing}"
        if not self._told:
            return self._words.unreadable
        if transform.far:
            return (
                f"positions are more than {FARTHEST_M / 1000.0:g} km from the world's origin; "
                "are the origin, and the offset of the system's frame, right?"
            )
        if transform.old:
            return f"positions are more than {OLDEST_S:g} s old by the clock that stamps them; does it stand still?"
        if transform.others and not transform.unknown:
            return f"tag {transform.tag} is not among those that are heard: {_listed(transform.tags)}"
        return "the system says that it has none; is there an anchor, or a satellite, that is not in sight?"

    def _notice(self, what: Literal["connected", "lost", "warned"], cause: str) -> None:
        self._notices.append(Notice(time_ns=time.monotonic_ns(), what=what, cause=cause))


def as_failure(device: str, error: Exception) -> Exception:
    """Error of a thread as a `DriverError`."""
    if isinstance(error, DriverError):
        return error
    return DriverError(device, f"its reader raised {words_of(error)}", "please report this")


def _listed(tags: set[str]) -> str:
    more = f" and {len(tags) - _MOST_TAGS} more" if len(tags) > _MOST_TAGS else ""
    return ", ".join(sorted(tags)[:_MOST_TAGS]) + more
