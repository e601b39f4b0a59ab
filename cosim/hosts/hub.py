"""The run's end of Eclipse Zenoh: the kernel's session is a router-mode hub, hosts dial in as clients."""

import contextlib
import functools
import json
import math
import os
import queue
import secrets
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.hosts import answer_checks, protocol
from vcmvsp.cosim.hosts.host_link import QUIET, LinkCallbacks, ZenohLink
from vcmvsp.cosim.hosts.protocol import Machine
from vcmvsp.cosim.transport import access_control, key_names
from vcmvsp.cosim.transport.zenoh_session import UNIX, closed, opened, threads

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys

LOOPBACK = "tcp/127.0.0.1:0"
"""A free port of this machine."""

_READS = "(rx: (handover: acc))"
"""Of Zenoh's threads in a hub for children, that which waits for their sockets also reads what comes, and calls back: as Zenoh
has it, it would wake another one for each message. Where strangers knock, it has them to deal with, and others read."""

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
_DOOR = 64  # who may wait at the door


class Hub:
    """The kernel's end: listens, admits hosts, and gives a link to each.

    Args:
        endpoint: Zenoh endpoint to listen on, e.g. ``tls/0.0.0.0:7447``; port 0 takes a free one. None: a Unix socket without a
            name, for child processes of this one.
        keys: the certificates of those who may come; None: anybody may.
        secret: of those who may come, where there are no certificates; None: anybody may.
        patience_s: wall-clock seconds for which hosts are to wait for a run that they are cut off from.
        cut_deadline_s: wall-clock seconds after which a host out of reach is given up.

    Attributes:
        endpoint: where hosts dial.
        files: file descriptors that a child process has to inherit in order to dial.

    Raises:
        UsageError: nothing can listen there.
    """

    def __init__(
        self,
        endpoint: str | None = LOOPBACK,
        keys: "Keys | None" = None,
        *,
        secret: str | None = None,
        patience_s: float = 2.0,
        cut_deadline_s: float = math.inf,
    ) -> None:
        if keys is not None:
            zenoh.init_log_from_env_or(access_control.LOG)
        secure = access_control.LIMITS if keys is None else access_control.hub_security(keys)
        self._strangers = endpoint is not None
        with contextlib.ExitStack() as stack, contextlib.ExitStack() as meanwhile:
            meanwhile.enter_context(threads("()" if self._strangers else _READS))
            if secret:
                known = meanwhile.enter_context(tempfile.TemporaryFile())  # without a name: a run that is killed leaves nothing
                secure = access_control.merge(secure, access_control.hub_secret(secret, known))
            folder = None if endpoint else Path(meanwhile.enter_context(tempfile.TemporaryDirectory(prefix="vcmvsp-")))
            # By number, for a socket's path has at most 107 bytes; open until Zenoh has removed what it made there.
            place = f"{UNIX}{_opened(stack, folder)}/hub" if folder else endpoint
            config = {"mode": "router", "listen": {"endpoints": [place]}, **QUEUES}
            config["adminspace"] = {"enabled": True, "permissions": {"read": True, "write": False}}
            self.session = opened(config, secure, f"cannot listen on '{place}'")
            stack.callback(closed, self.session)
            self.files = [_opened(stack, folder / "hub")] if folder else []
            self.endpoint = f"{UNIX}{self.files[0]}" if folder else self._locator()
            self._stack = stack.pop_all()
        self._keys, self._patience_s, self._cut_deadline_s = keys, patience_s, cut_deadline_s
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
            hello = protocol.hellos.decode(query.payload.to_bytes() if query.payload else b"")
            machine = speaker[0] if speaker else "", hello.host
            key = key_names.host_key(*machine, "ask")
            answer_checks.greeting(hello)
        except ValueError:
            self._reply(query, "that was no greeting of a vcmvsp host")
            return None

        denied, proof = None, secrets.token_bytes(protocol.SEAL)
        if hello.protocol != protocol.PROTOCOL:
            denied = f"this run speaks protocol {protocol.PROTOCOL}, the host {hello.protocol}: use the same vcmvsp version"
        elif self._keys is not None:
            from vcmvsp.cosim.security import certificates

            current = certificates.load(self._keys.folder)  # somebody may have been shut out since the run began to listen
            denied = access_control.admission(current, machine[0], hello.vehicles)

        def link(callbacks: LinkCallbacks) -> ZenohLink:
            seal = proof if self._strangers else b""
            made = ZenohLink(self.session, key, callbacks, seal=seal, cut_deadline_s=self._cut_deadline_s)
            self._links[machine] = made
            return made

        return Knock(
            hello, machine, denied, functools.partial(self._reply, query, seal=proof if self._strangers else b""), link
        )

    def open(self) -> None:
        """Somebody is missing: let those who come wait to be heard (`next_hello`)."""
        self._missing = True

    def shut(self) -> None:
        """Nobody is missing any more: refuse whoever comes while all are within reach."""
        self._missing = False
        self._send_away()

    def close(self) -> None:
        """Leave; hosts see the hub's token go."""
        self._stack.close()

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

    def _reply(self, query: zenoh.Query, refused: str | None, *, seal: bytes = b"") -> None:
        welcome = protocol.Welcome(refused, self._patience_s, b"" if refused else seal)
        with query:
            query.reply(query.key_expr, protocol.encode(welcome))

    def _locator(self) -> str:
        """Where the session really listens (the admin space knows the port that 0 became)."""
        for reply in self.session.get(f"@/{self.session.zid()}/router"):
            if reply.ok is not None:
                locators: list[str] = json.loads(reply.ok.payload.to_string())["locators"]
                if locators:
                    return locators[0]
        raise UsageError("the Zenoh session does not say where it listens")


def _opened(stack: contextlib.ExitStack, path: Path) -> int:
    """A file descriptor that stands for a path, whatever becomes of that."""
    number = os.open(path, os.O_PATH)
    stack.callback(os.close, number)
    return number


class Knock(NamedTuple):
    """A host that wants to join."""

    hello: protocol.Hello
    machine: Machine
    denied: str | None  # why its version or its certificate does not let it; None: they do
    reply: Callable[[str | None], None]  # the reason of a refusal, or None for welcome
    link: Callable[[LinkCallbacks], ZenohLink]

    def answer(self, refused: str | None, callbacks: LinkCallbacks = QUIET) -> ZenohLink | None:
        """Let the host in, or tell it the reason of its refusal; the link to a host that was let in."""
        why = self.denied or refused
        self.reply(why)
        return self.link(callbacks) if why is None else None
