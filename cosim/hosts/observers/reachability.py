"""How well a machine can reach a run: everything that both need of each other, tried one after the other."""

import hashlib
import queue
import ssl
import statistics
import time
from collections.abc import Iterator
from importlib import metadata
from typing import TYPE_CHECKING

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.hosts.event_publisher import ECHO
from vcmvsp.cosim.hosts.host_client import NO_RUN, dialling
from vcmvsp.cosim.hosts.observers.watcher import PATIENCE_S, POLL_S, ask, greeted, which
from vcmvsp.cosim.transport import access_control, key_names, tls_diagnosis
from vcmvsp.cosim.transport.zenoh_session import common_names, opened

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle

ROUNDS = 100
_SOMEBODY = "somebody-else"


Check = tuple[str, bool, str]
"""What was tried, whether it works, and what there is to say about it."""


def examine(endpoint: str, bundle: "Bundle | None", secret: str | None = None) -> Iterator[Check]:
    """Try all that a machine needs of a run at an endpoint, one after the other; the first that fails ends it.

    Args:
        endpoint: where the run listens.
        bundle: certificate of this machine; None: plain TCP.
        secret: of the run, without a certificate, as of `cosim.hosts.host_client.dial`.
    """
    if bundle is not None:
        own = _own_certificate(bundle)
        yield own
        if not own[1]:
            return
    refusal = tls_diagnosis.diagnose(endpoint, bundle)
    session = None if refusal else _session(endpoint, bundle, secret)
    if session is None:
        why = refusal.why if refusal else "it breaks off every connection" if bundle else NO_RUN
        yield ("endpoint", False, f"{endpoint}: {why}")
        return
    with session:
        yield ("endpoint", True, f"{endpoint}: a run answers there" if bundle else f"{endpoint}: something listens there")
        if bundle is not None:
            yield _certificate_of_run(endpoint, bundle, session)
        yield from _questions(session, bundle)


def _own_certificate(bundle: "Bundle") -> Check:
    authority = hashlib.sha256(ssl.PEM_cert_to_DER_cert(bundle.ca_pem)).hexdigest()[:16]
    meant = f"host of {', '.join(bundle.vehicles)}" if bundle.vehicles else bundle.role
    words = f"'{bundle.name}', {meant}, valid until {bundle.until:%Y-%m-%d}, of authority {authority}"
    try:
        warning = bundle.check()
    except UsageError as error:
        return ("certificate", False, str(error))
    return ("certificate", True, f"{words}; {warning}" if warning else words)


def _session(endpoint: str, bundle: "Bundle | None", secret: str | None) -> zenoh.Session | None:
    """A client session, tried for as long as a listener may pause after a connection that came to nothing."""
    connect = {"endpoints": [endpoint], "timeout_ms": 0}
    own = {"mode": "client", "listen": {"endpoints": []}, "connect": connect}
    last = time.monotonic() + PATIENCE_S
    while time.monotonic() < last:
        try:
            if (secure := dialling(endpoint, bundle, secret)) is None:
                return None
            return opened(own, secure, "")
        except UsageError:
            time.sleep(POLL_S)
    return None


def _certificate_of_run(endpoint: str, bundle: "Bundle", session: zenoh.Session) -> Check:
    try:
        access_control.check_hub(common_names(session))
        names, until = tls_diagnosis.shown(endpoint, bundle)
    except (UsageError, OSError) as error:
        return ("run's certificate", False, str(error))
    return ("run's certificate", True, f"for {', '.join(names)}, valid until {until:%Y-%m-%d}")


def _questions(session: zenoh.Session, bundle: "Bundle | None") -> Iterator[Check]:
    name = key_names.OPEN if bundle is None else bundle.name
    try:
        about = greeted(session, name)
    except UsageError as error:
        yield ("run", False, str(error))
        return
    yield ("run", True, which(about))
    ours = metadata.version("vcmvsp"), protocol.PROTOCOL
    theirs = about.version, about.protocol
    words = "vcmvsp {}, protocol {}"
    both = f"{words.format(*ours)} here, {words.format(*theirs)} there"
    if ours[1] != theirs[1]:
        yield ("versions", False, f"{both}: use the same vcmvsp version")
    else:
        yield ("versions", True, f"{words.format(*ours)} at both ends" if ours == theirs else both)
    yield from _times(session, name)
    yield _access(session, name, bundle)
    missing = ", ".join(about.missing)
    yield ("vehicles", True, f"{', '.join(about.vehicles)}; " + (f"still missing: {missing}" if missing else "none missing"))


def _times(session: zenoh.Session, name: str) -> Iterator[Check]:
    """Round trips, and the offset between the clocks as NTP has it: from the quickest of them (RFC 5905, section 8)."""
    trips: list[tuple[int, float]] = []  # ns; offset of the run's clock, ns
    for _ in range(ROUNDS):
        begin, began = time.time_ns(), time.perf_counter_ns()
        about = ask(session, name)
        took = time.perf_counter_ns() - began
        if about is None:
            yield ("round trip", False, f"the run answered {len(trips)} of {len(trips) + 1} questions")
            return
        trips.append((took, about.wall_ns - (begin + took / 2)))
    cuts = statistics.quantiles([took / 1e6 for took, _ in trips], n=100, method="inclusive")
    yield ("round trip", True, f"{cuts[49]:.2f} ms median, {cuts[98]:.2f} ms at the 99th percentile, of {ROUNDS}")
    took, offset = min(trips)
    direction = "ahead of" if offset > 0 else "behind"
    words = f"the run's is {abs(offset) / 1e6:.2f} ms {direction} ours, give or take {took / 2e6:.2f} ms"
    yield ("clocks", True, words)


def _access(session: zenoh.Session, name: str, bundle: "Bundle | None") -> Check:
    """What the run's rules let through: Zenoh denies in silence, so all is tried."""
    heard: queue.SimpleQueue[bool] = queue.SimpleQueue()

    def on_echo(_sample: zenoh.Sample) -> None:
        heard.put(True)

    subscriber = session.declare_subscriber(f"{key_names.TOPIC}echo/{name}", Callback(on_echo, indirect=False))
    ask(session, name, ECHO)
    try:
        hears = heard.get(timeout=PATIENCE_S if bundle is None or bundle.role == "observer" else PATIENCE_S / 4)
    except queue.Empty:
        hears = False
    subscriber.undeclare()  # type: ignore[no-untyped-call]
    speaks = ask(session, _SOMEBODY) is not None
    topics = "hears what the run shows" if hears else "does not hear what the run shows"
    others = "may speak for others" if speaks else "speaks for itself alone"
    if bundle is None:
        return ("access", True, f"no certificates are asked for: whoever reaches this endpoint {topics} and {others}")
    right = hears == (bundle.role == "observer") and not speaks
    return ("access", right, f"'{name}' {topics} and {others}" + ("" if right else f", which is not right for a {bundle.role}"))
