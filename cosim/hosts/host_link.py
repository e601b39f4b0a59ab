"""Questions to one host over Eclipse Zenoh, and its answers.

Both are publications, which Zenoh loses in silence when a link breaks. So they are numbered, and a host keeps its last answers:
one whose token comes back, or that has been silent for a second, is asked again all that is open, and does nothing twice.
"""

import contextlib
import math
import queue
import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.hosts.session import LateError, LinkError
from vcmvsp.cosim.transport import key_names

_RETRY_S = 0.02
_SPARE = 10  # answers that may wait beyond those that were asked for: some are given twice
_SLICE_S = 1.0  # after so long without an answer a question is asked again: a link that breaks may lose one in silence


class LinkCallbacks(NamedTuple):
    """What a link to a host asks and reports."""

    why_lost: Callable[[], str] = lambda: ""
    """Says how the host has ended; an empty answer: that is not known, and it may come back."""
    noticed: Callable[[bool], None] = lambda _: None
    """Called by Zenoh's thread, at once, when the host gets out of reach (False), and when it is back."""
    forged: Callable[[], None] = lambda: None
    """Called when another session first answers in the host's place; its answers are dropped."""
    released: Callable[[bool], None] = lambda _: None
    """Releases whatever runs the host; told whether it has answered to the last."""


QUIET = LinkCallbacks()


class ZenohLink:
    """A `cosim.hosts.session.Link` to one host.

    Args:
        session: the hub's.
        key: under which the host is asked.
        callbacks: what it asks and reports.
        seal: key of the seals on its answers (`protocol.sealed`); empty for a child of this run, which needs none. Answers of
            strangers are also limited in number, for they may answer what nobody has asked.
        cut_deadline_s: for how long it may be out of reach, whatever it was asked.

    Attributes:
        cuts_s: for how long it was out of reach, each time that the run waited for it.
        forged: answers of another session than the one that joined.
    """

    leaving = False
    _closed = False

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        callbacks: LinkCallbacks = QUIET,
        *,
        seal: bytes,
        cut_deadline_s: float = math.inf,
    ) -> None:
        self._news: queue.SimpleQueue[zenoh.Sample | bool] = queue.SimpleQueue()  # answers, and whether the host is there
        self._open: deque[_Question] = deque()
        self._ask = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        self._answers = zenoh.KeyExpr(key_names.answer_key(key))
        # A callback in Python costs more than it does: in a thread of Zenoh's, each call has memory mapped for its frames.
        take = self._on_answer if seal else self._news.put
        self._seal, self.forged = seal, 0
        self._hears = session.declare_subscriber(self._answers, Callback(take, indirect=False))
        self._number = 0
        self._asked_at = 0.0  # when all that is open was last asked
        self._there = True
        self._cut: float | None = None  # since when nobody is there
        self._failed = False
        self._callbacks, self._cut_deadline_s = callbacks, cut_deadline_s
        self.cuts_s: list[float] = []

    def there(self, there: bool) -> None:
        """Told by Zenoh's thread whether the host can be reached."""
        self._news.put(there)
        self._callbacks.noticed(there)

    def _on_answer(self, sample: zenoh.Sample) -> None:
        if not protocol.is_sealed(self._seal, sample.payload.to_bytes()):
            self.forged += 1
            if self.forged == 1:
                self._callbacks.forged()
            return
        if self._news.qsize() < len(self._open) + _SPARE:
            self._news.put(sample)

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Send a question; a host that is out of reach is asked again as soon as it is back."""
        self._number += 1
        now = time.monotonic()
        if not self._open:
            self._asked_at = now
        asked = _Question(self._number, question, deadline_s, now + deadline_s)
        self._open.append(asked)
        self._send(asked)

    def answer(self) -> bytes:
        """Wait for the answer to the oldest open question."""
        while True:  # a question stays open if Ctrl-C ends the waiting
            now, oldest = time.monotonic(), self._open[0]
            waits_s = min(oldest.last - now, _SLICE_S if self._there else _RETRY_S)
            if waits_s <= 0.0 or (not self._there and self._cut is not None and now - self._cut > self._cut_deadline_s):
                return self._last_look(oldest)
            try:
                answer = self._taken(self._news.get(timeout=waits_s))
            except queue.Empty:
                answer = None
                if self._there:
                    self._ask_again()
                else:
                    self._check_whether_ended()
            if answer is not None:
                return answer

    def look(self) -> bytes | None:
        """The answer to the oldest open question, if it is there, however late."""
        for _ in range(self._news.qsize()):
            if (answer := self._taken(self._news.get())) is not None:
                return answer
        if time.monotonic() - self._asked_at > _SLICE_S:
            self._ask_again()
        return None

    def _last_look(self, oldest: "_Question") -> bytes:
        """The answer, if it came while others were waited for."""
        answer = self.look()
        if answer is None:
            self._failed = True
            deadline_s = oldest.deadline_s if self._there else min(oldest.deadline_s, self._cut_deadline_s)
            gone = "" if self._cut is None else ": it left the run, or is cut off from it"
            raise LateError(f"did not answer within the deadline of {deadline_s:g} s{gone}")
        return answer

    def close(self) -> None:
        """Let go of whatever runs the host."""
        self.leaving = self._closed = True
        with contextlib.suppress(zenoh.ZError):  # the session may be closed
            self._farewell()
            self._hears.undeclare()  # type: ignore[no-untyped-call]
        self._callbacks.released(not self._failed)

    def _taken(self, news: "zenoh.Sample | bool") -> bytes | None:
        """The answer to the oldest question, if this is it."""
        if isinstance(news, bool):  # whether anybody is there who could answer
            self._there = news
            if news:
                self._ask_again()
            else:
                self._cut = self._cut or time.monotonic()
                self._check_whether_ended()
            return None
        content = news.payload.to_bytes()[protocol.SEAL if self._seal else 0 :]
        if len(content) < protocol.number.size or news.key_expr != self._answers:
            return None  # no answer of ours: a key with wildcards may be meant for many
        number, oldest = protocol.number.unpack_from(content)[0], self._open[0]
        if number != oldest.number:  # asked twice, answered twice
            return None
        if self._cut is not None:
            self.cuts_s.append(time.monotonic() - self._cut)
        self._cut, self._failed = None, False
        self._open.popleft()
        return content[protocol.number.size :]

    def _check_whether_ended(self) -> None:
        if ended := self._callbacks.why_lost():
            self._failed = True
            raise LinkError(ended)

    def repeat(self) -> None:
        """Ask once more all that is open; a host that was let go while it was out of reach is told so when it is back."""
        for each in list(self._open):
            self._send(each)
        if self._closed:
            self._farewell()

    def _farewell(self) -> None:
        """Say that no answer is waited for any more: it may leave, and need not give its last one again."""
        self._ask.put(protocol.numbers.pack(protocol.FAREWELL, self._number + 1))

    def _ask_again(self) -> None:
        self._asked_at = time.monotonic()
        self.repeat()

    def _send(self, asked: "_Question") -> None:
        self._ask.put(protocol.numbers.pack(asked.number, self._open[0].number) + asked.content)


class _Question(NamedTuple):
    """One that has not been answered."""

    number: int
    content: bytes
    deadline_s: float
    last: float
