"""Zenoh sessions with real certificates: a hub with a run's access rules, and its clients."""

import contextlib
import json
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

import pytest
import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.security import authority, certificates
from vcmvsp.cosim.security.certificates import Bundle, Keys
from vcmvsp.cosim.transport import access_control, key_names
from vcmvsp.cosim.transport.access_control import merge
from vcmvsp.cosim.transport.zenoh_session import COMMON

QUIET: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}},
}
LEASE_MS = 20_000
LASTING = {"transport": {"link": {"tx": {"lease": LEASE_MS}}}}
"""A machine may be held up for longer than the lease of the real ones: both ends of a link are in one process here."""
TOPIC = "vcmvsp/topic/car2/state"
PATIENCE_S = 20.0
EXCHANGED = (b"question", b"answer")  # keys between a run and its hosts


def start(config: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(merge(config, LASTING))))


def lasting_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long-lived connections for sessions that the product opens in this process."""
    monkeypatch.setattr(access_control, "LEASE_MS", LEASE_MS)
    monkeypatch.setitem(COMMON["transport"]["link"]["tx"], "lease", LEASE_MS)


def direct(function: Callable[[Any], object]) -> Any:
    return Callback(function, indirect=False)


def answer_queries(host: zenoh.Session, key: str, answer: Callable[[bytes], bytes] = lambda _: b"answer") -> None:
    """Answer the hub's queries under this key as a host does: outside of Zenoh's thread, which has to send as well."""
    publisher = host.declare_publisher(key_names.answer_key(key), congestion_control=zenoh.CongestionControl.BLOCK)
    queries: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    host.declare_subscriber(key, direct(queries.put))

    def work() -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has been closed
            while True:
                publisher.put(answer(queries.get().payload.to_bytes()))

    threading.Thread(target=work, daemon=True).start()


def reply(query: zenoh.Query, payload: bytes = b"ok") -> None:
    with query:
        query.reply(str(query.key_expr), payload)


def until(condition: Callable[[], object]) -> None:
    last = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < last, "it never came true"
        time.sleep(0.005)


class Hub:
    """A router with the rules, which answers greetings and counts everything that passes."""

    def __init__(self, rules: dict[str, Any], endpoints: tuple[str, ...] = ("tls/127.0.0.1:0",)) -> None:
        self.counts: Counter[str] = Counter()
        own = {"mode": "router", "listen": {"endpoints": list(endpoints)}, "adminspace": {"enabled": True}}
        self.session = start(merge(QUIET, own, rules))
        self.endpoints = self._locators()
        self.endpoint = self.endpoints[0]
        self._links: list[zenoh.LinkEvent] = []
        self.session.info.declare_link_events_listener(direct(self._links.append))
        for key in (key_names.JOIN, key_names.ABOUT, key_names.PAGE_SCENERY):
            self.session.declare_queryable(key, direct(self._on_greeting))
        self._token = self.session.liveliness().declare_token(key_names.HUB_ALIVE)
        watch = direct(lambda sample: self.counts.update([f"token {sample.key_expr}"]))
        self.session.liveliness().declare_subscriber("vcmvsp/**", watch)
        self.session.declare_subscriber("**", direct(self._on_sample))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.session.close()  # type: ignore[no-untyped-call]

    def ask(self, name: str, host: zenoh.Session, question: bytes = b"question", within_s: float = 1.0) -> list[bytes]:
        """Answer of a host, if one comes in time."""
        key, box = key_names.host_key(name, str(host.zid()), "ask"), queue.SimpleQueue[bytes]()
        hears = self.session.declare_subscriber(
            key_names.answer_key(key), direct(lambda sample: box.put(sample.payload.to_bytes()))
        )
        self.session.put(key, question, congestion_control=zenoh.CongestionControl.BLOCK)
        try:
            return [box.get(timeout=within_s)]
        except queue.Empty:
            return []
        finally:
            hears.undeclare()  # type: ignore[no-untyped-call]

    def links(self, name: str) -> list[bool]:
        """Links of this name: True for each that opened, False for each that closed."""
        return [each.kind == zenoh.SampleKind.PUT for each in self._links if each.link.auth_identifier == name]

    def _on_sample(self, sample: zenoh.Sample) -> None:
        payload = sample.payload.to_bytes()
        if not payload.isdigit() and not payload.startswith(EXCHANGED):
            self.counts.update([f"sample {sample.payload.to_string()}"])

    def _on_greeting(self, query: zenoh.Query) -> None:
        greeting = query.payload.to_bytes() if query.payload else b""
        self.counts.update([f"greeting {query.key_expr} {greeting[:5].decode()}"])
        reply(query, b"welcome")

    def _locators(self) -> list[str]:
        replies = self.session.get(f"@/{self.session.zid()}/router")
        (found,) = [json.loads(each.ok.payload.to_string())["locators"] for each in replies if each.ok]
        return list(found)


def issue_certificates(folder: Path) -> Keys:
    """An authority with certificates for the host of car2 and car3 and for the observer anna; one for 'gone' is revoked."""
    folder = folder / "keys"
    authority.init(folder)
    for name in ("car2", "car3", "gone"):
        authority.issue(folder, name, [name])
    authority.issue(folder, "anna")
    authority.revoke(folder, "gone")
    return certificates.load(folder)


def bundle(keys: Keys, name: str) -> Bundle:
    return certificates.load_bundle(keys.folder / f"{name}.keys")


def dial(endpoint: str, machine: Bundle | None, mode: str = "client") -> zenoh.Session:
    own = {"mode": mode, "listen": {"endpoints": []}, "connect": {"endpoints": [endpoint], "timeout_ms": 0}}
    return start(merge(QUIET, own, access_control.machine_security(machine) if machine else {}))


def replies_of(session: zenoh.Session, key: str, payload: bytes) -> list[bytes]:
    """Replies to a query."""
    return [each.ok.payload.to_bytes() for each in session.get(key, payload=payload, timeout=PATIENCE_S) if each.ok]


def greet(session: zenoh.Session, name: str, payload: bytes = b"hello") -> list[bytes]:
    return replies_of(session, key_names.join_key(name), payload)


def inquire(session: zenoh.Session, name: str, payload: bytes = b"about") -> list[bytes]:
    return replies_of(session, key_names.about_key(name), payload)


def settle() -> None:
    """Time in which forbidden messages could arrive; the test without rules shows that it is enough."""
    time.sleep(0.2)
