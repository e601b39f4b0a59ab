"""The run's end of Eclipse Zenoh: the kernel's session is a router-mode hub, hosts dial in as clients.

The host's end is `cosim.transport.dialling`; the keys, and who may use which, are in `cosim.transport.security`. A query, not
a pair of publications, carries each question: Zenoh then tells at once when nobody is there to answer. Questions are
numbered, and a host keeps its last answers: one that was cut off is asked again as soon as it is back, and does nothing twice.
Callbacks are always direct (no thread per callback) and only hand over to a queue.
"""

import contextlib
import json
import queue
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh
from zenoh.handlers import Callback

from cosim.errors import UsageError
from cosim.transport import security, wire
from cosim.transport.remote import LateError, LinkError

if TYPE_CHECKING:
    from cosim.certificates import Keys

LOOPBACK = "tcp/127.0.0.1:0"
"""A free port of this machine."""

COMMON: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": security.LEASE_MS}}},
}
_RETRY_S = 0.02


class Hub:
    """The kernel's end: listens, admits hosts, and gives a link to each.

    Args:
        endpoint: Zenoh endpoint to listen on, e.g. ``tls/0.0.0.0:7447``; port 0 takes a free one.
        keys: the certificates of those who may come; None: anybody may.
        deadline_s: wall-clock seconds within which hosts must answer; they wait as long for a run that they are cut off from.

    Raises:
        UsageError: nothing can listen there.
    """

    def __init__(self, endpoint: str = LOOPBACK, keys: "Keys | None" = None, *, deadline_s: float = 2.0) -> None:
        config = {"mode": "router", "listen": {"endpoints": [endpoint]}}
        config["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
        if keys is not None:
            zenoh.init_log_from_env_or(security.LOG)
        self._session = opened(config, {} if keys is None else security.hub_security(keys), f"cannot listen on '{endpoint}'")
        self.endpoint = self._locator()
        self._keys, self._deadline_s = keys, deadline_s
        self._joins: queue.SimpleQueue[zenoh.Query] = queue.SimpleQueue()
        self._shut = False
        self.gone: set[str] = set()  # sessions of hosts that have left
        session = self._session
        self._watch = session.liveliness().declare_subscriber(security.ALIVE, Callback(self._on_token, indirect=False))
        self._door = session.declare_queryable(security.JOIN, Callback(self._on_join, indirect=False))
        self._token = session.liveliness().declare_token(security.HUB_ALIVE)

    def next_hello(self, timeout_s: float) -> "Knock | None":
        """The next host that knocks, and how to answer it: with why it is refused, or None to let it in."""
        try:
            query = self._joins.get(timeout=timeout_s)
        except queue.Empty:
            return None
        speaker = security.speaker(str(query.key_expr))
        try:
            hello = wire.hellos.decode(query.payload.to_bytes() if query.payload else b"")
            key = security.host_key(speaker[0] if speaker else "", hello.host, "ask")
        except ValueError:
            self._reply(query, "that was no greeting of a vcmvsp host")
            return None

        def answer(refused: str | None) -> ZenohLink | None:
            if refused is None and hello.protocol != wire.PROTOCOL:
                refused = f"this run speaks protocol {wire.PROTOCOL}, the host {hello.protocol}: use the same vcmvsp version"
            self._reply(query, refused)
            return None if refused else ZenohLink(self._session, key)

        denied = None
        if self._keys is not None and speaker is not None:
            from cosim import certificates

            current = certificates.load(self._keys.folder)  # somebody may have been shut out since the run began to listen
            denied = security.admission(current, speaker[0], hello.vehicles)
        return Knock(hello, speaker[0] if speaker else "", denied, answer)

    def shut(self) -> None:
        """Nobody is missing any more: refuse whoever still comes."""
        self._shut = True
        with contextlib.suppress(queue.Empty):
            while True:
                self._refuse(self._joins.get_nowait())

    def close(self) -> None:
        """Leave; hosts see the hub's token go."""
        self._session.close()  # type: ignore[no-untyped-call]

    def _on_token(self, sample: zenoh.Sample) -> None:
        speaker = security.speaker(str(sample.key_expr))
        if speaker is not None and sample.kind == zenoh.SampleKind.DELETE:
            self.gone.add(speaker[1])

    def _on_join(self, query: zenoh.Query) -> None:
        if self._shut:
            self._refuse(query)
        else:
            self._joins.put(query)

    def _refuse(self, query: zenoh.Query) -> None:
        self._reply(query, "it has begun, and nobody is missing")

    def _reply(self, query: zenoh.Query, refused: str | None) -> None:
        with query:
            query.reply(query.key_expr, wire.encode(wire.Welcome(refused=refused, deadline_s=self._deadline_s)))

    def _locator(self) -> str:
        """Where the session really listens (the admin space knows the port that 0 became)."""
        for reply in self._session.get(f"@/{self._session.zid()}/router"):
            if reply.ok is not None:
                locators: list[str] = json.loads(reply.ok.payload.to_string())["locators"]
                if locators:
                    return locators[0]
        raise UsageError("the Zenoh session does not say where it listens")


class Knock(NamedTuple):
    """A host that wants to join."""

    hello: wire.Hello
    name: str  # of its certificate
    denied: str | None  # why its certificate does not let it; None: it does
    answer: "Callable[[str | None], ZenohLink | None]"  # with why it is refused, or None to let it in


class ZenohLink:
    """A `cosim.transport.remote.Link` to one host.

    Args:
        session: the hub's.
        key: of the host's queryable.

    Attributes:
        why_lost: says how the host has ended; an empty answer: that is not known, and it may come back.
        released: lets go of whatever runs the host; told whether it has answered to the last.
    """

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._session, self._key = session, key
        self._open: deque[_Question] = deque()
        self._asked = 0
        self.why_lost: Callable[[], str] = lambda: ""
        self.released: Callable[[bool], None] = lambda _: None
        self._failed = False

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Send a question; Zenoh ends it without a reply as soon as nobody is there who could answer."""
        self._asked += 1
        asked = _Question(self._asked, question, deadline_s, time.monotonic() + deadline_s)
        asked.replies = self._get(asked)
        self._open.append(asked)

    def answer(self) -> bytes:
        """Wait for the answer to the oldest open question."""
        oldest = self._open[0]  # it stays open if Ctrl-C ends the waiting
        while True:
            try:
                reply = oldest.replies.recv()
                break
            except zenoh.ZError:
                self._ask_again(oldest)
        self._open.popleft()
        if reply.ok is None:
            self._failed = True
            raise LateError(f"did not answer within the deadline of {oldest.deadline_s:g} s")
        return reply.ok.payload.to_bytes()

    def close(self) -> None:
        """Let go of whatever runs the host."""
        self.released(not self._failed)

    def _ask_again(self, oldest: "_Question") -> None:
        """Ask all that is open once more, for as long as the host may still come back."""
        ended = self.why_lost()
        if not ended and time.monotonic() + _RETRY_S >= oldest.last:
            ended = f"did not answer within the deadline of {oldest.deadline_s:g} s: it left the run, or is cut off from it"
        if ended:
            self._failed = True
            raise LinkError(ended)
        time.sleep(_RETRY_S)
        for each in self._open:
            each.replies = self._get(each)

    def _get(self, asked: "_Question") -> "zenoh.Handler[zenoh.Reply]":
        left_s = max(_RETRY_S, asked.last - time.monotonic())
        attachment = wire.numbers.pack(asked.number, self._open[0].number if self._open else asked.number)
        return self._session.get(self._key, payload=asked.content, attachment=attachment, timeout=left_s)


class _Question:
    """One that has not been answered."""

    replies: "zenoh.Handler[zenoh.Reply]"

    def __init__(self, number: int, content: bytes, deadline_s: float, last: float) -> None:
        self.number, self.content, self.deadline_s, self.last = number, content, deadline_s, last


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
