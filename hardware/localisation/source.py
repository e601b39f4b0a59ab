"""Common part of all sources of positions: readings wait until the caller takes them, and silence is reported with its cause.

The thread that receives something passes it to `PositionSource.take` at once, so that it is stamped on arrival. Times of
measurement come from the system's own clock if it has one (`cosim.estimation.clock_offset`), else from the arrival. Frames of
systems are rotated by ``turn_rad`` and then moved by ``offset`` into the world. Positions that are not finite, or more than
10 km from the world's origin, are rejected.
"""

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple, Protocol, runtime_checkable

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import words_of
from vcmvsp.cosim.estimation.clock_offset import ForeignClock
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import ORIGIN, Fix, NonNegative, Positive, Vec3
from vcmvsp.hardware.drivers.base import DriverError, HandshakeError, Notice


class Located(msgspec.Struct, frozen=True, kw_only=True):
    """One answer of a positioning system."""

    tag: str = ""  # number or name of the tag; empty: the only one of the port
    position: Vec3 | None = None  # m, in the system's own frame (GPS: of the tangent plane); None: no position now
    velocity: tuple[float, float] | None = None  # m/s, east and north
    sigma_m: float | None = None  # standard deviation of x and y; None: not in the message
    yaw: float | None = None  # rad
    sigma_rad: float = 0.0  # standard deviation of the yaw; not positive: the yaw is unknown
    quality: float | None = None  # 0 to 1, where the system gives such a number
    source_ns: int | None = None  # time of the measurement, of the system's clock; None: not in the message


Baud = Annotated[int, msgspec.Meta(ge=50, le=4_000_000)]


@runtime_checkable
class Localisation(Protocol):
    """Protocol of positioning systems of a real vehicle: open, read fixes, close."""

    device: str  # for messages

    def open(self) -> None:
        """Start receiving; takes some seconds at most; `PortError`: the port or address cannot be opened, and the remedy."""

    def read(self, now_ns: int) -> list[Fix]:
        """Readings until ``now_ns``, oldest first, without waiting; `DriverError`: none can come, or their tag is ambiguous."""

    def notices(self) -> list[Notice]:
        """Events since the last call, oldest first: positions arrive, are lost, and why."""

    def close(self) -> None:
        """Stop receiving and free the port. May be called twice, and after a failure."""


class DatagramReader:
    """Decodes datagrams of one position each, and counts invalid ones, for which ``decode`` raises `ValueError`."""

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
    """Splits a stream of bytes into lines and decodes these; longer lines than ``longest_bytes`` are dropped.

    ``decode`` returns None for a line about something else, and raises `ValueError` for an invalid one; both are counted.
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


FARTHEST_M = 10_000.0  # from the world's origin; beyond, the frame is wrong
OLDEST_S = 10.0  # older positions are useless; a clock that stands still gives such times
MOST_TAGS = 64  # of one system
LEAST_SIGMA_M = LEAST_SIGMA_RAD = 1e-3  # minimum standard deviations


class WorldTransform:
    """Transforms positions of one tag (empty: any) into the world and to this machine's clock.

    ``sigma_m`` holds for messages without one, ``latency_s`` is the minimum delay from measurement to arrival; the system's
    frame is turned by ``turn_rad``, counter-clockwise, and moved by ``offset``, m; ``normal`` gives the normal form of a tag's
    name.
    """

    def __init__(
        self,
        *,
        tag: str = "",
        sigma_m: Positive,
        latency_s: NonNegative,
        offset: Vec3 = ORIGIN,
        turn_rad: float = 0.0,
        normal: Callable[[str], str] = str.upper,
    ) -> None:
        if not all(map(math.isfinite, (*offset, turn_rad))):
            raise ValueError(f"offset and turn_rad must be finite, not {offset} and {turn_rad}")
        self._normal, self.tag = normal, normal(tag)
        self._sigma_m, self._offset, self._turn = sigma_m, offset, turn_rad
        self._cosine, self._sine = math.cos(turn_rad), math.sin(turn_rad)
        self._latency_s = latency_s
        self._clocks: dict[str, ForeignClock] = {}  # by tag: messages of two tags may come in any order
        self.tags: set[str] = set()  # tags in messages so far
        self.rejected: Counter[str] = Counter()  # unknown: without a position; far; old; others: of other tags

    @property
    def jumps(self) -> int:
        """Number of jumps of the system's clock."""
        return sum(each.jumps for each in self._clocks.values())

    def place(self, located: Located, arrived_ns: int) -> Fix | None:
        """Position in the world; None if it is rejected."""
        tag = self._normal(located.tag)
        if tag and len(self.tags) < MOST_TAGS:
            self.tags.add(tag)
        if tag and (tag != self.tag if self.tag else tag not in self.tags):
            self.rejected["others"] += 1
            return None
        time_ns = self._time(located, tag, arrived_ns)
        sigma_m = located.sigma_m if located.sigma_m is not None and math.isfinite(located.sigma_m) else 0.0
        if located.position is None or sigma_m > FARTHEST_M:
            self.rejected["unknown"] += 1
            return None
        x, y, z = located.position
        placed = (
            self._offset[0] + self._cosine * x - self._sine * y,
            self._offset[1] + self._sine * x + self._cosine * y,
            self._offset[2] + z,
        )
        if not math.hypot(*placed) <= FARTHEST_M:  # true for NaN
            self.rejected["far"] += 1
            return None
        if time_ns < arrived_ns - seconds_to_ns(OLDEST_S):
            self.rejected["old"] += 1
            return None
        yaw, sigma_rad = self._heading(located)
        sigma_m = max(sigma_m or self._sigma_m, LEAST_SIGMA_M)
        return Fix(time_ns=time_ns, position=placed, yaw=yaw, sigma_m=sigma_m, sigma_rad=sigma_rad)

    def _heading(self, posed: Located) -> tuple[float | None, float]:
        """Yaw in the world and its standard deviation, if they are usable."""
        if posed.yaw is None or not math.isfinite(posed.yaw) or not 0.0 < posed.sigma_rad <= math.pi:
            return None, 0.0
        return wrap(posed.yaw + self._turn), max(posed.sigma_rad, LEAST_SIGMA_RAD)

    def _time(self, located: Located, tag: str, arrived_ns: int) -> int:
        """Time of the measurement; a clock at zero counts as none."""
        if not located.source_ns:
            return arrived_ns - seconds_to_ns(self._latency_s)
        if tag not in self._clocks:
            self._clocks[tag] = ForeignClock(least_s=self._latency_s)
        return self._clocks[tag].local_time_ns(located.source_ns, arrived_ns)


PATIENCE_S = 5.0  # without a position before a warning
CENSUS_S = 1.0  # of listening, before a single tag counts as the only one
_MOST_WAITING = 1000  # readings, if the caller takes none
_MOST_TAGS = 8  # that a message lists


class Advice(NamedTuple):
    """Texts of a source's warnings."""

    nothing: str  # remedy if nothing arrives
    unreadable: str  # remedy if only invalid messages arrive


class PositionSource:
    """A source of positions without its port: see `hardware.localisation.source.Localisation`."""

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
        """New readings, see `Localisation.read`."""
        with self._lock:
            if self._failure is not None:
                raise self._failure
            self._look(now_ns)
            fixes = [each for each in self._fixes if each.time_ns <= now_ns]
            later = [each for each in self._fixes if each.time_ns > now_ns]  # after the caller's time
            self._fixes = deque(later, _MOST_WAITING)
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
                self._count += 1
                jumps = self._transform.jumps
                fix = self._transform.place(located, arrived_ns)
                if self._transform.jumps > jumps:
                    self._notice("warned", "the clock of the position stamps has jumped; clock offset is estimated again")
                if fix is not None and self._is_ours(arrived_ns):
                    self._fixes.append(fix)
                    self._good(arrived_ns)
            return bool(answers)

    def lost(self, cause: str) -> None:
        """Report that the port is lost."""
        with self._lock:
            self._notice("lost", cause)
            self._is_lost = self._silent = True

    def back(self) -> None:
        """Report that the port is open again."""
        with self._lock:
            self._expect(time.monotonic_ns())

    def failed(self, error: Exception) -> None:
        """Report that no further reading will come."""
        failure = DriverError(self.device, f"its reader raised {words_of(error)}", "report this error")
        with self._lock:
            self._failure = error if isinstance(error, DriverError) else failure

    def _begin(self) -> None:
        self._failure = self._first_tag_ns = None
        self._transform.tags.clear()
        self._silent = True  # until the first position, which is reported
        self._fixes.clear()
        self._expect(time.monotonic_ns())

    def _expect(self, now_ns: int) -> None:
        self._is_lost, self._told_why, self._since_ns = False, "", now_ns
        self._bytes = self._count = 0
        self._transform.rejected.clear()

    def _good(self, now_ns: int) -> None:
        if self._silent:
            tag = f" of tag {self._transform.tag}" if self._transform.tag else ""
            self._notice("connected", f"positions{tag} come")
        self._silent = False
        self._expect(now_ns)

    def _is_ours(self, now_ns: int) -> bool:
        """Whether a position is the vehicle's: without a tag name there must be one tag only."""
        transform = self._transform
        if transform.tag or not transform.tags:
            return True
        if self._first_tag_ns is None:
            self._first_tag_ns = now_ns
        waited = now_ns - self._first_tag_ns >= CENSUS_S * SECOND_NS
        if waited and len(transform.tags) > 1 and self._failure is None:
            happened = f"positions of {len(transform.tags)} tags come: {_listed(transform.tags)}"
            self._failure = HandshakeError(self.device, happened, "choose the vehicle's: tag = ...")
        return waited and len(transform.tags) == 1

    def _look(self, now_ns: int) -> None:
        """Warn when positions stay away, and again for each new reason."""
        if self._is_lost or now_ns - self._since_ns <= PATIENCE_S * SECOND_NS:
            return
        why = self._why()
        if why != self._told_why:
            self._notice("warned", f'no position for {PATIENCE_S:g} s: {why}; localisation.kind = "none" drives by odometry')
            self._told_why, self._silent = why, True

    def _why(self) -> str:
        rejected = self._transform.rejected
        if not self._bytes:
            return f"nothing comes; {self._words.nothing}"
        if not self._count:
            return self._words.unreadable
        if rejected["far"]:
            far = f"positions are more than {FARTHEST_M / 1000.0:g} km from the world's origin"
            return f"{far}; check the origin, and the offset of the system's frame"
        if rejected["old"]:
            return f"position stamps are more than {OLDEST_S:g} s old; check that their clock runs"
        if rejected["others"] and not rejected["unknown"]:
            return f"no position of tag {self._transform.tag}; received tags: {_listed(self._transform.tags)}"
        return "the system reports none; check the line of sight to anchors or satellites"

    def _notice(self, what: Literal["connected", "lost", "warned"], cause: str) -> None:
        self._notices.append(Notice(time_ns=time.monotonic_ns(), what=what, cause=cause))


def _listed(tags: set[str]) -> str:
    more = f" and {len(tags) - _MOST_TAGS} more" if len(tags) > _MOST_TAGS else ""
    return ", ".join(sorted(tags)[:_MOST_TAGS]) + more
