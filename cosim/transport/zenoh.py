"""Hosts over Eclipse Zenoh: the kernel's session is a router-mode hub, hosts dial in as clients. The one home of Zenoh.

Keys, all under ``vcmvsp/``::

    hub/join            queryable of the hub: a host's `Hello`, answered by a `Welcome`
    hub/alive           liveliness token of the hub
    host/<zid>/ask      queryable of a host: one question, one answer
    host/<zid>/alive    liveliness token of a host

A query, rather than a pair of publications, carries each question: Zenoh then tells at once when nobody is there to answer.
Callbacks are always direct (no thread per callback) and only hand over to a queue.
"""

import contextlib
import json
import queue
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import zenoh
from zenoh.handlers import Callback

from cosim.errors import FederateError, UsageError
from cosim.transport import wire
from cosim.transport.remote import Desk, LateError, LinkError

JOIN, HUB_ALIVE = "vcmvsp/hub/join", "vcmvsp/hub/alive"
LOOPBACK = "tcp/127.0.0.1:0"
"""A free port of this machine."""

_COMMON: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}},
}
_NO_TIMEOUT_S = 1e6  # a host may wait for its run as long as its user likes


class Hub:
    """The kernel's end: listens, admits hosts, and gives a link to each.

    Args:
        endpoint: Zenoh endpoint to listen on, e.g. ``tcp/0.0.0.0:7447``; port 0 takes a free one.

    Raises:
        UsageError: nothing can listen there.
    """

    def __init__(self, endpoint: str = LOOPBACK) -> None:
        config = {**_COMMON, "mode": "router", "listen": {"endpoints": [endpoint]}}
        config["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
        try:
            self._session = zenoh.open(_config(config))
        except zenoh.ZError as error:
            raise UsageError(f"cannot listen on '{endpoint}': {_first_line(error)}") from error
        self.endpoint = self._locator()
        self._joins: queue.SimpleQueue[zenoh.Query] = queue.SimpleQueue()
        self._token = self._session.liveliness().declare_token(HUB_ALIVE)
        self._door = self._session.declare_queryable(JOIN, Callback(self._on_join, indirect=False))
        self._shut = False
        self.gone: set[str] = set()  # hosts that have left
        watch = Callback(self._on_token, indirect=False)
        self._watch = self._session.liveliness().declare_subscriber("vcmvsp/host/*/alive", watch)

    def next_hello(self, timeout_s: float) -> "Knock | None":
        """The next host that knocks, and how to answer it: with why it is refused, or None to let it in."""
        try:
            query = self._joins.get(timeout=timeout_s)
        except queue.Empty:
            return None
        try:
            hello = wire.hellos.decode(query.payload.to_bytes() if query.payload else b"")
        except ValueError:
            self._reply(query, wire.Welcome(refused="that was no greeting of a vcmvsp host"))
            return None

        def answer(refused: str | None) -> ZenohLink | None:
            if refused is None and hello.protocol != wire.PROTOCOL:
                refused = f"this run speaks protocol {wire.PROTOCOL}, the host {hello.protocol}: use the same vcmvsp version"
            self._reply(query, wire.Welcome(refused=refused))
            return None if refused else ZenohLink(self._session, hello.host)

        return hello, answer

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
        if sample.kind == zenoh.SampleKind.DELETE:
            self.gone.add(str(sample.key_expr).split("/")[2])

    def _on_join(self, query: zenoh.Query) -> None:
        if self._shut:
            self._refuse(query)
        else:
            self._joins.put(query)

    def _refuse(self, query: zenoh.Query) -> None:
        self._reply(query, wire.Welcome(refused="it has begun, and nobody is missing"))

    def _reply(self, query: zenoh.Query, welcome: wire.Welcome) -> None:
        with query:
            query.reply(JOIN, wire.encode(welcome))

    def _locator(self) -> str:
        """Where the session really listens (the admin space knows the port that 0 became)."""
        for reply in self._session.get(f"@/{self._session.zid()}/router"):
            if reply.ok is not None:
                locators: list[str] = json.loads(reply.ok.payload.to_string())["locators"]
                if locators:
                    return locators[0]
        raise UsageError("the Zenoh session does not say where it listens")


Knock = tuple[wire.Hello, Callable[[str | None], "ZenohLink | None"]]
"""A host that wants to join, and how to answer it."""


class ZenohLink:
    """A `cosim.transport.remote.Link` to one host."""

    def __init__(self, session: zenoh.Session, host: str) -> None:
        self._session, self._key = session, f"vcmvsp/host/{host}/ask"
        self._open: deque[tuple[zenoh.Handler[zenoh.Reply], float]] = deque()
        self.why_lost: Callable[[], str] = lambda: "left the run: its process ended or the connection broke"
        self.released: Callable[[bool], None] = lambda _: None
        self._failed = False

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Send a question; Zenoh ends it without a reply as soon as nobody is there who could answer."""
        self._open.append((self._session.get(self._key, payload=question, timeout=deadline_s), deadline_s))

    def answer(self) -> bytes:
        """Wait for the answer to the oldest open question."""
        replies, deadline_s = self._open[0]  # it stays open if Ctrl-C ends the waiting
        try:
            reply = replies.recv()
        except zenoh.ZError:
            self._failed = True
            raise LinkError(self.why_lost()) from None
        self._open.popleft()
        if reply.ok is None:
            self._failed = True
            raise LateError(f"did not answer within the deadline of {deadline_s:g} s")
        return reply.ok.payload.to_bytes()

    def close(self) -> None:
        """Let go of whatever runs the host."""
        self.released(not self._failed)


def serve(
    hello: Callable[[str], wire.Hello],
    desk: Desk,
    endpoint: str,
    *,
    on_state: Callable[[str], None] = lambda _: None,
) -> str:
    """Run a host: dial in, wait for a run, answer its questions until it ends, and give the reason for its end.

    Args:
        hello: makes the greeting, given the host's own id.
        desk: answers the questions.
        endpoint: of the hub, e.g. ``tcp/192.168.1.10:7447``; it need not be there yet.
        on_state: told what is being waited for.

    Raises:
        UsageError: the endpoint is none, or the hub refuses this host.
        FederateError: an agent of this host failed, or the run is gone.
    """
    with _dial(endpoint, on_state) as session:
        host = str(session.zid())
        inbox: queue.SimpleQueue[zenoh.Query | None] = queue.SimpleQueue()
        key = f"vcmvsp/host/{host}/ask"
        queryable = session.declare_queryable(key, Callback(inbox.put, indirect=False))
        token = session.liveliness().declare_token(f"vcmvsp/host/{host}/alive")

        def on_hub(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.DELETE:
                inbox.put(None)

        watch = session.liveliness().declare_subscriber(HUB_ALIVE, Callback(on_hub, indirect=False), history=True)
        _join(session, hello(host))
        on_state("joined; waiting for the run to begin")
        try:
            while desk.ended is None:
                query = inbox.get()
                if query is None:
                    raise FederateError("the run", "is gone: its process ended or the connection broke")
                with query:
                    query.reply(key, desk.handle(query.payload.to_bytes() if query.payload else b""))
            if desk.failure is not None:
                raise desk.failure
            return desk.ended
        finally:
            desk.close()
            for handle in (watch, token, queryable):
                handle.undeclare()  # type: ignore[no-untyped-call]


@contextlib.contextmanager
def _dial(endpoint: str, on_state: Callable[[str], None]) -> Iterator[zenoh.Session]:
    """A client session to the hub, as soon as there is one. Short attempts, so that Ctrl-C is heard in between."""
    config = {**_COMMON, "mode": "client", "listen": {"endpoints": []}}
    config["connect"] = {"endpoints": [endpoint], "timeout_ms": 0}
    told = False
    while True:
        try:
            session = zenoh.open(_config(config))
            break
        except zenoh.ZError as error:
            if "Unable to connect" not in str(error):
                raise UsageError(f"cannot connect to '{endpoint}': {_first_line(error)}") from error
            if not told:
                on_state(f"waiting for a run at {endpoint}")
                told = True
            time.sleep(0.1)
    with session:
        yield session


def _join(session: zenoh.Session, hello: wire.Hello) -> None:
    for reply in session.get(JOIN, payload=wire.encode(hello), timeout=_NO_TIMEOUT_S):
        if reply.ok is not None:
            refused = wire.welcomes.decode(reply.ok.payload.to_bytes()).refused
            if refused:
                raise UsageError(f"the run refuses this host: {refused}")
            return
    raise UsageError("the run ended before it let this host in")


def _config(values: dict[str, Any]) -> zenoh.Config:
    return zenoh.Config.from_json5(json.dumps(values))


def _first_line(error: Exception) -> str:
    return str(error).splitlines()[0].partition(" at /")[0]  # the rest is where in Zenoh's sources
