"""The run's end of Eclipse Zenoh: the kernel's session is a router-mode hub, and hosts dial in as clients.

Questions and answers are publications, which Zenoh loses silently when a link breaks. So they are numbered, and a host keeps
its last answers. All open questions are repeated to a host whose token returns or that is silent for a second; it repeats the
answers and acts only once.
"""

import contextlib
import json
import math
import os
import queue
import secrets
import tempfile
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.hosts.protocol import Machine
from vcmvsp.cosim.hosts.remote_host import LateError, LinkError
from vcmvsp.cosim.transport import access_control, key_names
from vcmvsp.cosim.transport.zenoh_session import UNIX, closed, opened, threads, undeclare

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys

_RETRY_S = 0.02
_SPARE = 10  # answers that may wait beyond the number of questions: some arrive twice
_SLICE_S = 1.0  # interval at which an unanswered question is repeated: a broken link may lose one silently

LOOPBACK = "tcp/127.0.0.1:0"
"""Endpoint on a free port of this machine."""

_READS = "(rx: (handover: acc))"
"""Zenoh's receive executor in a hub for children: the thread that waits for the sockets also reads and calls back. By default
Zenoh wakes another thread for each message. A hub for other machines keeps the default: its reader also handles strangers.
"""

_QUEUE = {
    "size": {"data_low": 16},  # of 64 KiB each: room for one picture
    "congestion_control": {"drop": {"max_wait_before_drop_fragments": 5000}},  # us that a fragment may wait for room
}
QUEUES: dict[str, Any] = {"transport": {"link": {"tx": {"queue": _QUEUE}}}}
"""Transmit queues of the hub: an observer that stops reading pictures delays the run by 5 ms, not 50."""
_SPARE_JOINS = 64  # join requests that may wait, in addition to one for each expected host
BEGUN = "it has started, and no host is missing"


class LinkCallbacks(NamedTuple):
    """Callbacks of a link to a host."""

    why_lost: Callable[[], str] = lambda: ""
    """The reason for which the host has ended; empty: unknown, and the host may return."""
    noticed: Callable[[bool], None] = lambda _: None
    """Called at once, in Zenoh's thread, with False when the host becomes unreachable and True when it is back."""
    forged: Callable[[], None] = lambda: None
    """Called when another session first answers in the host's place; its answers are dropped."""
    released: Callable[[bool], None] = lambda _: None
    """Releases the process of the host; the argument is whether the host answered to the last."""


QUIET = LinkCallbacks()


class ZenohLink:
    """A `cosim.hosts.remote_host.SessionLink` to one host.

    Args:
        seal: key of the seals on its answers (`protocol.sealed`); empty for a child process of this run, which needs none. With
            a seal, the number of waiting answers is limited: strangers may send answers without a question.

    Attributes:
        forged: number of answers from sessions other than the one that joined.
    """

    leaving = False
    _closed = False

    def __init__(
        self,
        session: zenoh.Session,
        key: str,  # key expression of the questions to the host
        callbacks: LinkCallbacks = QUIET,
        *,
        seal: bytes,
        cut_deadline_s: float = math.inf,  # longest time for which the host may be unreachable
    ) -> None:
        self._news: queue.SimpleQueue[zenoh.Sample | bool] = queue.SimpleQueue()  # answers, and changes of the host's presence
        self._open: deque[_Question] = deque()
        self._ask = session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        self._answers = zenoh.KeyExpr(key_names.answer_key(key))
        # A bound method of C code is cheaper: each Python call in a Zenoh thread maps memory for its frames.
        take = self._on_answer if seal else self._news.put
        self._seal, self.forged = seal, 0
        self._subscriber = session.declare_subscriber(self._answers, Callback(take, indirect=False))
        self._number = 0
        self._asked_at = 0.0  # time at which the open questions were last sent
        self._is_reachable = True
        self._cut: float | None = None  # time since which the host is unreachable
        self._failed = False
        self._callbacks, self._cut_deadline_s = callbacks, cut_deadline_s
        self.cuts_s: list[float] = []  # durations for which the run waited for the unreachable host

    def set_reachable(self, is_reachable: bool) -> None:
        """Note whether the host is reachable; called by Zenoh's thread."""
        self._news.put(is_reachable)
        self._callbacks.noticed(is_reachable)

    def _on_answer(self, sample: zenoh.Sample) -> None:
        if not protocol.is_sealed(self._seal, sample.payload.to_bytes()):
            self.forged += 1
            if self.forged == 1:
                self._callbacks.forged()
            return
        if self._news.qsize() < len(self._open) + _SPARE:
            self._news.put(sample)

    def ask(self, question: bytes, deadline_s: float) -> None:
        """Send a question; it is repeated when an unreachable host is back."""
        self._number += 1
        now = time.monotonic()
        if not self._open:
            self._asked_at = now
        entry = _Question(self._number, question, deadline_s, now + deadline_s)
        self._open.append(entry)
        self._send(entry)

    def answer(self) -> bytes:
        """Wait for the answer to the oldest open question."""
        while True:  # a question stays open if Ctrl-C interrupts the wait
            now, oldest = time.monotonic(), self._open[0]
            waits_s = min(oldest.last - now, _SLICE_S if self._is_reachable else _RETRY_S)
            if waits_s <= 0.0 or (not self._is_reachable and self._cut is not None and now - self._cut > self._cut_deadline_s):
                return self._last_look(oldest)
            try:
                answer = self._accept(self._news.get(timeout=waits_s))
            except queue.Empty:
                answer = None
                self._extend(time.monotonic() - now - waits_s)
                if self._is_reachable:
                    self._ask_again()
                else:
                    self._check_whether_ended()
            if answer is not None:
                return answer

    def _extend(self, stalled_s: float) -> None:
        """Add the time in which this process stood still to the deadlines of all open questions."""
        self._open = deque(each._replace(last=each.last + stalled_s) for each in self._open)

    def look(self) -> bytes | None:
        """The answer to the oldest open question if it has arrived, even late."""
        for _ in range(self._news.qsize()):
            if (answer := self._accept(self._news.get())) is not None:
                return answer
        if time.monotonic() - self._asked_at > _SLICE_S:
            self._ask_again()
        return None

    def _last_look(self, oldest: "_Question") -> bytes:
        answer = self.look()
        if answer is None:
            self._failed = True
            deadline_s = oldest.deadline_s if self._is_reachable else min(oldest.deadline_s, self._cut_deadline_s)
            reason = "" if self._cut is None else ": it left the run, or its connection is lost"
            raise LateError(f"did not answer within the deadline of {deadline_s:g} s{reason}")
        return answer

    def close(self) -> None:
        """Release the process of the host."""
        self.leaving = self._closed = True
        with contextlib.suppress(zenoh.ZError):  # the session may be closed
            self._farewell()
        undeclare(self._subscriber)
        self._callbacks.released(not self._failed)

    def _accept(self, news: "zenoh.Sample | bool") -> bytes | None:
        """The answer to the oldest question, if ``news`` is that."""
        if isinstance(news, bool):  # whether the host is reachable
            self._is_reachable = news
            if news:
                self._ask_again()
            else:
                self._cut = self._cut or time.monotonic()
                self._check_whether_ended()
            return None
        content = news.payload.to_bytes()[protocol.SEAL if self._seal else 0 :]
        if len(content) < protocol.number.size or news.key_expr != self._answers:
            return None  # not an answer to this link: its key may contain wildcards
        number, oldest = protocol.number.unpack_from(content)[0], self._open[0]
        if number != oldest.number:  # a repeated answer to a repeated question
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
        """Repeat all open questions; a host that was released while unreachable gets its farewell."""
        for each in list(self._open):
            self._send(each)
        if self._closed:
            self._farewell()

    def _farewell(self) -> None:
        """Tell the host that the run expects no more answers: it may exit without repeating its last one."""
        self._ask.put(protocol.numbers.pack(protocol.FAREWELL, self._number + 1))

    def _ask_again(self) -> None:
        self._asked_at = time.monotonic()
        self.repeat()

    def _send(self, entry: "_Question") -> None:
        self._ask.put(protocol.numbers.pack(entry.number, self._open[0].number) + entry.content)


class _Question(NamedTuple):
    number: int
    content: bytes
    deadline_s: float
    last: float


class Hub:
    """The kernel's end of Zenoh: listens, admits hosts, and makes a link to each.

    Args:
        endpoint: Zenoh endpoint to listen on, e.g. ``tls/0.0.0.0:7447``; port 0 takes a free one. None: a Unix socket without a
            name, for child processes of this one.

    Attributes:
        files: file descriptors that a child process has to inherit in order to dial.

    Raises:
        UsageError: the hub cannot listen at the endpoint.
    """

    def __init__(
        self,
        endpoint: str | None = LOOPBACK,
        keys: "Keys | None" = None,  # certificates of admitted machines; None: no certificates are required
        *,
        secret: str | None = None,  # shared secret, where there are no certificates; None: none is required
        patience_s: float = 2.0,  # reconnect timeout of hosts, wall-clock seconds
        cut_deadline_s: float = math.inf,  # wall-clock seconds after which an unreachable host is lost
        hosts: int = 0,  # largest number of expected hosts: all may ask to join at the same time
    ) -> None:
        if keys is not None:
            zenoh.init_log_from_env_or(access_control.LOG)
        secure = access_control.LIMITS if keys is None else access_control.hub_security(keys)
        self._strangers = endpoint is not None
        with contextlib.ExitStack() as stack, contextlib.ExitStack() as meanwhile:
            meanwhile.enter_context(threads("()" if self._strangers else _READS))
            if secret:
                file = meanwhile.enter_context(tempfile.TemporaryFile())  # without a name: a killed run leaves nothing behind
                secure = access_control.merge(secure, access_control.hub_secret(secret, file))
            folder = None if endpoint else Path(meanwhile.enter_context(tempfile.TemporaryDirectory(prefix="vcmvsp-")))
            # By descriptor: a socket's path has at most 107 bytes. Open until Zenoh has removed its files there.
            place = f"{UNIX}{_opened(stack, folder)}/hub" if folder else endpoint
            config = {"mode": "router", "listen": {"endpoints": [place]}, **QUEUES}
            config["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
            self.session = opened(config, secure, f"cannot listen on '{place}' (--listen chooses another port)")
            stack.callback(closed, self.session)
            self.files = [_opened(stack, folder / "hub")] if folder else []
            self.endpoint = f"{UNIX}{self.files[0]}" if folder else self._locator()  # endpoint that hosts dial
            self._stack = stack.pop_all()
        self._keys, self._patience_s, self._cut_deadline_s = keys, patience_s, cut_deadline_s
        self._room = _SPARE_JOINS + hosts
        self._joins: queue.SimpleQueue[zenoh.Query] = queue.SimpleQueue()
        self._missing = True  # an agent has no host yet, or has lost it
        self.gone: dict[Machine, float] = {}  # time at which the token of a host disappeared
        self._links: dict[Machine, ZenohLink] = {}
        session = self.session
        self._watch = session.liveliness().declare_subscriber(key_names.ALIVE, Callback(self._on_token, indirect=False))
        self._door = session.declare_queryable(key_names.JOIN, Callback(self._on_join, indirect=False))
        self._token = session.liveliness().declare_token(key_names.HUB_ALIVE)

    def next_hello(self, timeout_s: float) -> "Knock | None":
        """The next host that asks to join, with a function that admits it (None) or refuses it (a reason)."""
        try:
            query = self._joins.get(timeout=timeout_s)
        except queue.Empty:
            return None
        speaker = key_names.speaker(str(query.key_expr))
        try:
            hello = protocol.hellos.decode(query.payload.to_bytes() if query.payload else b"")
            machine = speaker[0] if speaker else "", hello.host
            key = key_names.host_key(*machine, "ask")
            protocol.check_greeting(hello)
        except ValueError:
            self._reply(query, "that is not the join request of a vcmvsp host")
            return None

        denied, seal = None, secrets.token_bytes(protocol.SEAL) if self._strangers else b""
        if hello.protocol != protocol.PROTOCOL:
            denied = f"this run speaks protocol {protocol.PROTOCOL}, the host {hello.protocol}: use the same vcmvsp version"
        elif self._keys is not None:
            from vcmvsp.cosim.security import certificates

            current = certificates.load(self._keys.folder)  # certificates may have been revoked since the run began to listen
            denied = access_control.admission(current, machine[0], hello.vehicles)

        def settle(refused: str | None, callbacks: LinkCallbacks) -> ZenohLink | None:
            self._reply(query, refused, seal=seal)
            if refused is not None:
                return None
            link = self._links[machine] = ZenohLink(
                self.session, key, callbacks, seal=seal, cut_deadline_s=self._cut_deadline_s
            )
            return link

        return Knock(hello, machine, denied, settle)

    def open(self) -> None:
        """Accept join requests (`next_hello`) from now on, because an agent has no host."""
        self._missing = True

    def shut(self) -> None:
        """Reject join requests from now on, because every agent has a reachable host."""
        self._missing = False
        self._send_away()

    def close(self) -> None:
        """Close the session; hosts see the hub's token disappear."""
        self._stack.close()

    def _on_token(self, sample: zenoh.Sample) -> None:
        speaker = key_names.speaker(str(sample.key_expr))
        if speaker is None:
            return
        is_present = sample.kind == zenoh.SampleKind.PUT
        if is_present:
            self.gone.pop(speaker, None)
        else:
            self.gone[speaker] = time.monotonic()
        link = self._links.get(speaker)
        if link is None:
            return
        if not link.leaving:
            link.set_reachable(is_present)
            self._send_away()
        elif is_present:
            link.repeat()

    def _is_open(self) -> bool:
        """Whether join requests are accepted: an unreachable host may have been killed and restarted under another id."""
        links = (self._links.get(machine) for machine in list(self.gone))
        return self._missing or any(link is not None and not link.leaving for link in links)

    def _send_away(self) -> None:
        with contextlib.suppress(queue.Empty):
            while not self._is_open():
                self._reply(self._joins.get_nowait(), BEGUN)

    def _on_join(self, query: zenoh.Query) -> None:
        if not self._is_open():
            self._reply(query, BEGUN)
        elif self._joins.qsize() < self._room:
            self._joins.put(query)
        else:
            self._reply(query, "too many join requests at once; try again")

    def _reply(self, query: zenoh.Query, refused: str | None, *, seal: bytes = b"") -> None:
        welcome = protocol.Welcome(refused, self._patience_s, b"" if refused else seal)
        with query:
            query.reply(query.key_expr, protocol.encode(welcome))

    def _locator(self) -> str:
        """The endpoint at which the session listens (the admin space knows the port chosen for 0)."""
        for reply in self.session.get(f"@/{self.session.zid()}/router"):
            if reply.ok is not None:
                locators: list[str] = json.loads(reply.ok.payload.to_string())["locators"]
                if locators:
                    return locators[0]
        raise UsageError("the Zenoh session has no listening endpoint")


def _opened(stack: contextlib.ExitStack, path: Path) -> int:
    """A file descriptor for a path, valid even if the path is renamed or removed."""
    number = os.open(path, os.O_PATH)
    stack.callback(os.close, number)
    return number


class Knock(NamedTuple):
    """A host that asks to join."""

    hello: protocol.Hello
    machine: Machine
    denied: str | None  # reason to refuse its version or its certificate; None: both are valid
    settle: Callable[[str | None, LinkCallbacks], ZenohLink | None]  # admits (None) or refuses (a reason)

    def answer(self, refused: str | None, callbacks: LinkCallbacks = QUIET) -> ZenohLink | None:
        """Admit the host (returns its link), or refuse it with a reason."""
        return self.settle(self.denied or refused, callbacks)
