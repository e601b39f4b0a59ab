"""The run's end of Eclipse Zenoh: the kernel's session is a router-mode hub, hosts dial in as clients.

The host's end is `cosim.transport.dialling`; the keys are in `cosim.transport.key_names`, and who may use which in
`cosim.transport.security`. Questions and answers are publications, which Zenoh loses in silence when a link breaks. So they are
numbered, and a host keeps its last answers: one whose token comes back, or that has been silent for a second, is asked again
all that is open, and does nothing twice.
Callbacks are always direct (no thread per callback) and only hand over to a queue.
"""

import contextlib
import json
import math
import os
import queue
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh
from zenoh.handlers import Callback

from cosim.errors import UsageError
from cosim.transport import checking, key_names, security, wire
from cosim.transport.crew import LateError, LinkError
from cosim.transport.wire import Machine

if TYPE_CHECKING:
    from cosim.certificates import Keys

LOOPBACK = "tcp/127.0.0.1:0"
"""A free port of this machine."""

UNIX = "unixsock-stream/"
"""How the children of a run reach it: the endpoint's beginning, before the path of a socket."""

_READS = "(rx: (handover: acc))"
"""Of Zenoh's threads in a hub for children, that which waits for their sockets also reads what comes, and calls back: as Zenoh
has it, it would wake another one for each message. Where strangers knock, it has them to deal with, and others read."""

COMMON: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": security.LEASE_MS}}},
}
QUEUES: dict[str, Any] = {
    "transport": {
        "link": {
            "tx": {
                "queue": {
                    "size": {"data_low": 16},  # 64 KiB each: room for one picture
                    "congestion_control": {"drop": {"max_wait_before_drop_fragments": 5000}},  # us that it may wait for more
                }
            }
        }
    }
}
"""Of the hub, so that an observer that takes no more pictures holds the run up for 5 ms, not 50."""
_RETRY_S = 0.02
_DOOR = 64  # who may wait at the door
_SPARE = 10  # answers that may wait beyond those that were asked for: some are given twice
_SLICE_S = 1.0  # after so long without an answer a question is asked again: a link that breaks may lose one in silence


class Hub:
    """The kernel's end: listens, admits hosts, and gives a link to each.

    Args:
        endpoint: Zenoh endpoint to listen on, e.g. ``tls/0.0.0.0:7447``; port 0 takes a free one.
        keys: the certificates of those who may come; None: anybody may.
        patience_s: wall-clock seconds for which hosts are to wait for a run that they are cut off from.

    Raises:
        UsageError: nothing can listen there.
    """

    def __init__(self, endpoint: str = LOOPBACK, keys: "Keys | None" = None, *, patience_s: float = 2.0) -> None:
        config = {"mode": "router", "listen": {"endpoints": [endpoint]}, **QUEUES}
        config["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
        if keys is not None:
            zenoh.init_log_from_env_or(security.LOG)
        secure = security.LIMITS if keys is None else security.hub_security(keys)
        self._strangers = not endpoint.startswith(UNIX)
        with threads("()" if self._strangers else _READS):
            self.session = opened(config, secure, f"cannot listen on '{endpoint}'")
        self.endpoint = self._locator()
        self._keys, self._patience_s = keys, patience_s
        self._joins: queue.SimpleQueue[zenoh.Query] = queue.SimpleQueue()
        self._missing = True  # the run has no host yet for one of its agents, or has lost one
        self.gone: dict[Machine, float] = {}  # hosts whose token has gone, and when
        self._links: dict[Machine, ZenohLink] = {}
        session = self.session
        self._watch = session.liveliness().declare_subscriber(key_names.ALIVE, Callback(self._on_token, indirect=False))
        self._door = session.declare_queryable(key_names.JOIN, Callback(self._on_join, indirect=False))
        self._token = session.liveliness().declare_token(key_names.HUB_ALIVE)

    def next_hello(self, timeout_s: float) -> "Knock | None":
        """The next host that knocks, and how to answer it: with why it is refused, or None to let it in."""
        try:
            query = self._joins.get(timeout=timeout_s)
        except queue.Empty:
            return None
        speaker = key_names.speaker(str(query.key_expr))
        try:
            hello = wire.hellos.decode(query.payload.to_bytes() if query.payload else b"")
            machine = speaker[0] if speaker else "", hello.host
            key = key_names.host_key(*machine, "ask")
            checking.greeting(hello)
        except ValueError:
            self._reply(query, "that was no greeting of a vcmvsp host")
            return None

        denied = None
        if hello.protocol != wire.PROTOCOL:
            denied = f"this run speaks protocol {wire.PROTOCOL}, the host {hello.protocol}: use the same vcmvsp version"
        elif self._keys is not None:
            from cosim import certificates

            current = certificates.load(self._keys.folder)  # somebody may have been shut out since the run began to listen
            denied = security.admission(current, machine[0], hello.vehicles)

        def answer(refused: str | None) -> ZenohLink | None:
            self._reply(query, denied or refused)
            return None if denied or refused else self._linked(machine, key)

        return Knock(hello, machine, denied, answer)

    def open(self) -> None:
        """Somebody is missing: let those who come wait to be heard (`next_hello`)."""
        self._missing = True

    def shut(self) -> None:
        """Nobody is missing any more: refuse whoever comes while all are within reach."""
        self._missing = False
        self._send_away()

    def close(self) -> None:
        """Leave; hosts see the hub's token go."""
        self.session.close()  # type: ignore[no-untyped-call]

    def _on_token(self, sample: zenoh.Sample) -> None:
        speaker = key_names.speaker(str(sample.key_expr))
        if speaker is None:
            return
        there = sample.kind == zenoh.SampleKind.PUT
        if there:
            self.gone.pop(speaker, None)
        else:
            self.gone[speaker] = time.monotonic()
        link = self._links.get(speaker)
        if link is None:
            return
        if not link.leaving:
            link.there(there)
            self._send_away()
        elif there:
            link.repeat()

    def _linked(self, machine: Machine, key: str) -> "ZenohLink":
        link = self._links[machine] = ZenohLink(self.session, key, stranger=self._strangers)
        return link

    def _is_open(self) -> bool:
        """Whether somebody may be needed: who is out of reach may have been killed, and be back under another id."""
        gone = (self._links.get(machine) for machine in list(self.gone))
        return self._missing or any(link is not None and not link.leaving for link in gone)

    def _send_away(self) -> None:
        """Refuse those who wait, if nobody is needed."""
        with contextlib.suppress(queue.Empty):
            while not self._is_open():
                self._refuse(self._joins.get_nowait())

    def _on_join(self, query: zenoh.Query) -> None:
        if not self._is_open():
            self._refuse(query)
        elif self._joins.qsize() < _DOOR:
            self._joins.put(query)
        else:
            self._reply(query, "too many knock at once; try again")

    def _refuse(self, query: zenoh.Query) -> None:
        self._reply(query, "it has begun, and nobody is missing")

    def _reply(self, query: zenoh.Query, refused: str | None) -> None:
        with query:
            query.reply(query.key_expr, wire.encode(wire.Welcome(refused=refused, patience_s=self._patience_s)))

    def _locator(self) -> str:
        """Where the session really listens (the admin space knows the port that 0 became)."""
        for reply in self.session.get(f"@/{self.session.zid()}/router"):
            if reply.ok is not None:
                locators: list[str] = json.loads(reply.ok.payload.to_string())["locators"]
                if locators:
                    return locators[0]
        raise UsageError("the Zenoh session does not say where it listens")


class Knock(NamedTuple):
    """A host that wants to join."""

    hello: wire.Hello
    machine: Machine
    denied: str | None  # why its version or its certificate does not let it; None: they do
    answer: "Callable[[str | None], ZenohLink | None]"  # with why it is refused, or None to let it in


class ZenohLink:
    """A `cosim.transport.crew.Link` to one host.

    Args:
        session: the hub's.
        key: under which the host is asked.
        stranger: it may flood the run with answers to nothing, which are then dropped; children of a run do not.

    Attributes:
        why_lost: says how the host has ended; an empty answer: that is not known, and it may come back.
        noticed: told by Zenoh's thread, and at once, when the host is out of reach (False), and when it is back.
        released: lets go of whatever runs the host; told whether it has answered to the last.
        cut_deadline_s: for how long it may be out of reach, whatever it was asked.
        cuts_s: for how long it was out of reach, each time that the run waited for it.
    """

    leaving = False

    def __init__(self, session: zenoh.Session, key: str, *, stranger: bool = True) -> None:
        self._news: queue.SimpleQueue[zenoh.Sample | bool] = queue.SimpleQueue()  # answers, and whether the host is there
        self._open: deque[_Question] = deque()
        self._ask = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        self._answers = zenoh.KeyExpr(key_names.answer_key(key))
        # A callback in Python costs more than it does: in a thread of Zenoh's, each call has memory mapped for its frames.
        take = self._on_answer if stranger else self._news.put
        self._hears = session.declare_subscriber(self._answers, Callback(take, indirect=False))
        self._number = 0
        self._asked_at = 0.0  # when all that is open was last asked
        self._there = True
        self._cut: float | None = None  # since when nobody is there
        self._failed = False
        self.why_lost: Callable[[], str] = lambda: ""
        self.noticed: Callable[[bool], None] = lambda _: None
        self.released: Callable[[bool], None] = lambda _: None
        self.cuts_s: list[float] = []
        self.cut_deadline_s = math.inf

    def there(self, there: bool) -> None:
        """Told by Zenoh's thread whether the host can be reached."""
        self._news.put(there)
        self.noticed(there)

    def _on_answer(self, sample: zenoh.Sample) -> None:
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
            if waits_s <= 0.0 or (not self._there and self._cut is not None and now - self._cut > self.cut_deadline_s):
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
            deadline_s = oldest.deadline_s if self._there else min(oldest.deadline_s, self.cut_deadline_s)
            gone = "" if self._cut is None else ": it left the run, or is cut off from it"
            raise LateError(f"did not answer within the deadline of {deadline_s:g} s{gone}")
        return answer

    def close(self) -> None:
        """Let go of whatever runs the host."""
        self.leaving = True
        with contextlib.suppress(zenoh.ZError):  # the session may be closed
            self._hears.undeclare()  # type: ignore[no-untyped-call]
        self.released(not self._failed)

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
        content = news.payload.to_bytes()
        if len(content) < wire.number.size or news.key_expr != self._answers:
            return None  # no answer of ours: a key with wildcards may be meant for many
        number, oldest = wire.number.unpack_from(content)[0], self._open[0]
        if number != oldest.number:  # asked twice, answered twice
            return None
        if self._cut is not None:
            self.cuts_s.append(time.monotonic() - self._cut)
        self._cut, self._failed = None, False
        self._open.popleft()
        return content[wire.number.size :]

    def _check_whether_ended(self) -> None:
        if ended := self.why_lost():
            self._failed = True
            raise LinkError(ended)

    def repeat(self) -> None:
        """Ask once more all that is open; a host that was let go while it was out of reach is told so when it is back."""
        for each in self._open:
            self._send(each)

    def _ask_again(self) -> None:
        self._asked_at = time.monotonic()
        self.repeat()

    def _send(self, asked: "_Question") -> None:
        self._ask.put(wire.numbers.pack(asked.number, self._open[0].number) + asked.content)


class _Question(NamedTuple):
    """One that has not been answered."""

    number: int
    content: bytes
    deadline_s: float
    last: float


@contextlib.contextmanager
def threads(shared: str) -> Iterator[None]:
    """How Zenoh's threads share their work, which it reads when a process opens its first session; not for children of it."""
    if "ZENOH_RUNTIME" in os.environ:
        yield
        return
    os.environ["ZENOH_RUNTIME"] = shared
    try:
        yield
    finally:
        os.environ.pop("ZENOH_RUNTIME", None)


def opened(own: dict[str, Any], secure: dict[str, Any], failure: str) -> zenoh.Session:
    """A session of this configuration.

    Raises:
        UsageError: there can be none; the message begins with ``failure``.
    """
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(security.merge(COMMON, own, secure))))
    except zenoh.ZError as error:
        raise UsageError(f"{failure}: {first_line(error)}") from error


def first_line(error: Exception) -> str:
    """What Zenoh says, without where in its sources."""
    return str(error).splitlines()[0].partition(" at /")[0]


def common_names(session: zenoh.Session) -> Iterable[str | None]:
    """The names on the certificates at the other ends of a session's links."""
    return [link.auth_identifier for link in session.info.links()]
