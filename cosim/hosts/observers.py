"""Observers of a run on other machines (the hub's end: `cosim.hosts.event_publisher`); they never change it.

`watch` receives its events; `examine` tests the connection between a machine and a run.
"""

import contextlib
import hashlib
import queue
import ssl
import statistics
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from importlib import metadata
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.hosts.event_publisher import ECHO, About, stamp
from vcmvsp.cosim.hosts.host_client import NO_RUN, dial, dialling, hub_of
from vcmvsp.cosim.transport import access_control, key_names, zenoh_session
from vcmvsp.cosim.transport.zenoh_session import client, common_names, undeclare
from vcmvsp.cosim.util.documents import read_json

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle

PATIENCE_S = 2.0  # an unreachable run may return, and a new one may not answer yet
BACKLOG = 100_000  # events that wait for a slow terminal; later ones are dropped
POLL_S = 0.05

ROUNDS = 100
_SOMEBODY = "somebody-else"

Check = tuple[str, bool, str]
"""What was tested, whether it works, and details."""


class Observed(NamedTuple):
    """The connection of an observer to a run."""

    session: zenoh.Session
    endpoint: str
    about: About
    presence: "_Presence"
    on_state: Callable[[str], None]

    def samples(self, keys: Sequence[str], every_s: float = 0.0) -> Generator[list[zenoh.Sample], None, None]:
        """Samples of these keys, in batches ``every_s`` apart (0: as they come), until the run has ended."""
        inbox: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        lost = 0

        def on_sample(sample: zenoh.Sample) -> None:
            nonlocal lost
            if inbox.qsize() < BACKLOG:
                inbox.put(sample)
            else:
                lost += 1

        for key in keys:
            self.session.declare_subscriber(key, Callback(on_sample, indirect=False))
        self.on_state(f"watching {self.endpoint}: {which(self.about)}")
        over = False
        while not over:
            over = self.presence.is_over()  # asked first, so that samples received until then are still returned
            if batch := _batch(inbox, every_s):
                yield batch
        dropped = f"; {lost} samples were dropped: too many to take" if lost else ""
        self.on_state(f"the run has ended, or is unreachable{dropped}")


@contextlib.contextmanager
def observed(
    endpoint: str,
    *,
    bundle: "Bundle | None" = None,  # certificate of this observer; None: plain TCP
    secret: str | None = None,  # secret of the run, without a certificate, as in `cosim.hosts.host_client.dial`
    on_state: Callable[[str], None] = lambda _: None,  # called with the state of the connection
) -> Iterator[Observed]:
    """Connect to a run, as soon as it listens.

    Raises:
        UsageError: the run refuses this observer, or the certificate is a host's.
    """
    if bundle is not None and bundle.role != "observer":
        owner = ", ".join(bundle.vehicles)
        raise UsageError(f"{bundle.path}: is for the host of {owner}; to watch, use a file made by 'vcmvsp keys observer NAME'")
    with dial(endpoint, bundle, on_state, secret=secret) as session:
        about = greeted(session, key_names.OPEN if bundle is None else bundle.name)
        yield Observed(session, endpoint, about, _Presence(session, endpoint, bundle), on_state)


class TopicValue(NamedTuple):
    """An event of the run on arrival."""

    time_ns: int  # simulated
    topic: str  # e.g. car2/command
    type: str  # the tag of the value, e.g. velocity
    payload: bytes  # JSON

    @property
    def value(self) -> Any:
        """The value as lists, mappings, numbers and strings; None: it cannot be decoded."""
        try:
            return read_json(self.payload)
        except (ValueError, RecursionError):
            return None


def watch(
    endpoint: str,
    topics: Sequence[str] = ("**",),  # key expressions to subscribe to, e.g. ``car2/*``
    *,
    every_s: float = 0.0,  # batch interval
    **connection: Any,  # as of `observed`
) -> Generator[list[TopicValue], None, None]:
    """Events of a run, until it ends; waits for a run that has not begun.

    Raises:
        UsageError: the run refuses this observer, or an argument is wrong.
    """
    for topic in topics:
        try:
            zenoh.KeyExpr(key_names.TOPIC + topic)
        except zenoh.ZError as error:
            problem = "must be a topic such as car2/command, with * for one part and ** for any number"
            raise UsageError(f"--topic {topic}: {problem}") from error
    with observed(endpoint, **connection) as run:
        for samples in run.samples([key_names.TOPIC + topic for topic in topics], every_s):
            if batch := [item for sample in samples if (item := _topic_value(sample))]:
                yield batch


class _Presence:
    """Presence of the run: its token and, once that has disappeared, the id of the hub at its endpoint."""

    def __init__(self, session: zenoh.Session, endpoint: str, bundle: "Bundle | None") -> None:
        self._session, self._endpoint, self._bundle = session, endpoint, bundle
        self._hub = hub_of(session)
        self._gone_at: float | None = None  # time at which its token disappeared
        self._cut_at: float | None = None  # time at which its session was lost
        changes = Callback(self._on_token, indirect=False)
        session.liveliness().declare_subscriber(key_names.HUB_ALIVE, changes, history=True)

    def is_over(self) -> bool:
        """Whether the run has ended, or is unreachable for good."""
        present = hub_of(self._session)
        if present not in (self._hub, ""):
            return True  # another hub listens there now
        if present:
            self._cut_at = None
        elif self._cut_at is None:
            self._cut_at = time.monotonic()
        since = self._gone_at or self._cut_at
        if since is None:
            return False
        refusal = zenoh_session.diagnose(self._endpoint, self._bundle)
        hopeless = (refusal is not None and refusal.final) or time.monotonic() > since + PATIENCE_S
        if not hopeless:
            time.sleep(POLL_S)
        return hopeless and (self._gone_at or self._cut_at) is not None  # it may be back meanwhile

    def _on_token(self, sample: zenoh.Sample) -> None:
        self._gone_at = None if sample.kind == zenoh.SampleKind.PUT else time.monotonic()


def _batch(inbox: "queue.SimpleQueue[zenoh.Sample]", every_s: float) -> list[zenoh.Sample]:
    """Samples that arrive within ``every_s``; if that is 0, waits for the first and returns all that are there."""
    samples: list[zenoh.Sample] = []
    last = time.monotonic() + (every_s or POLL_S)
    while (left_s := last - time.monotonic()) > 0.0:
        try:
            samples.append(inbox.get(timeout=left_s))
        except queue.Empty:
            break
        if not every_s and inbox.empty():
            break
    return samples


def _topic_value(sample: zenoh.Sample) -> TopicValue | None:
    key, when = str(sample.key_expr), sample.attachment
    if "*" in key or when is None or len(when) != stamp.size:
        return None  # not a sample of a run
    (time_ns,) = stamp.unpack(when.to_bytes())
    kind = str(sample.encoding).rpartition(";")[2]
    return None if kind == "echo" else TopicValue(time_ns, key.removeprefix(key_names.TOPIC), kind, sample.payload.to_bytes())


def ask(session: zenoh.Session, name: str, payload: bytes = b"") -> About | None:
    """The run's description of itself at the key of ``name``; None: no answer."""
    for reply in session.get(key_names.about_key(name), payload=payload, timeout=PATIENCE_S):
        if reply.ok is not None:
            try:
                answer: About = read_json(reply.ok.payload.to_bytes(), About)
            except ValueError:
                return None
            return answer
    return None


def greeted(session: zenoh.Session, name: str) -> About:
    """The description of a run that may just have begun to listen; `UsageError` if it does not answer."""
    last = time.monotonic() + PATIENCE_S
    while (about := ask(session, name)) is None:
        if time.monotonic() > last:
            outdated = "the listener there does not identify its run: use the same vcmvsp version at both ends"
            raise UsageError(outdated if name == key_names.OPEN else access_control.silence(name))
        time.sleep(POLL_S)
    return about


def which(about: About) -> str:
    """A run in a few words."""
    length = "" if about.duration_s is None else f" of {about.duration_s:g} s"
    when = "not begun yet" if about.time_ns is None else f"now at {about.time_ns / 1e9:.1f} s{length}"
    return f"{about.scenario or 'a run'} ({len(about.vehicles)} vehicles), {when}"


def examine(endpoint: str, bundle: "Bundle | None", secret: str | None = None) -> Iterator[Check]:
    """Test step by step what a machine needs of a run at an endpoint; stops at the first failure.

    Args:
        secret: secret of the run, without a certificate, as in `cosim.hosts.host_client.dial`.
    """
    if bundle is not None:
        own = _own_certificate(bundle)
        yield own
        if not own[1]:
            return
    refusal = zenoh_session.diagnose(endpoint, bundle)
    session = None if refusal else _session(endpoint, bundle, secret)
    if session is None:
        unknown = "it closes every connection" if bundle else NO_RUN
        why = refusal.why if refusal else unknown
        yield ("endpoint", False, f"{endpoint}: {why}")
        return
    with session:
        yield ("endpoint", True, f"{endpoint}: a run answers there" if bundle else f"{endpoint}: the port is open")
        if bundle is not None:
            yield _certificate_of_run(endpoint, bundle, session)
        yield from _questions(session, bundle)


def _own_certificate(bundle: "Bundle") -> Check:
    authority = hashlib.sha256(ssl.PEM_cert_to_DER_cert(bundle.ca_pem)).hexdigest()[:16]
    purpose = f"host of {', '.join(bundle.vehicles)}" if bundle.vehicles else bundle.role
    words = f"'{bundle.name}', {purpose}, valid until {bundle.until:%Y-%m-%d}, of authority {authority}"
    try:
        warning = bundle.check()
    except UsageError as error:
        return ("certificate", False, str(error))
    return ("certificate", True, f"{words}; {warning}" if warning else words)


def _session(endpoint: str, bundle: "Bundle | None", secret: str | None) -> zenoh.Session | None:
    """A client session; retries for as long as a listener may pause after a failed connection."""
    last = time.monotonic() + PATIENCE_S
    while time.monotonic() < last:
        try:
            if (secure := dialling(endpoint, bundle, secret)) is None:
                return None
            return client(endpoint, secure, "")
        except UsageError:
            time.sleep(POLL_S)
    return None


def _certificate_of_run(endpoint: str, bundle: "Bundle", session: zenoh.Session) -> Check:
    try:
        access_control.check_hub(common_names(session))
        names, until = zenoh_session.run_certificate(endpoint, bundle)
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
    """Round-trip times, and the clock offset of the quickest one, as in NTP (RFC 5905, section 8)."""
    trips: list[tuple[int, float]] = []  # ns; offset of the run's clock, ns
    for _ in range(ROUNDS):
        begin, began = time.time_ns(), time.perf_counter_ns()
        about = ask(session, name)
        took = time.perf_counter_ns() - began
        if about is None:
            yield ("round trip", False, f"the run answered {len(trips)} of {len(trips) + 1} requests")
            return
        trips.append((took, about.wall_ns - (begin + took / 2)))
    cuts = statistics.quantiles([took / 1e6 for took, _ in trips], n=100, method="inclusive")
    yield ("round trip", True, f"{cuts[49]:.2f} ms median, {cuts[98]:.2f} ms at the 99th percentile, of {ROUNDS}")
    took, offset = min(trips)
    direction = "ahead of" if offset > 0 else "behind"
    words = f"the run's clock is {abs(offset) / 1e6:.2f} ms {direction} this machine's, +- {took / 2e6:.2f} ms"
    yield ("clocks", True, words)


def _access(session: zenoh.Session, name: str, bundle: "Bundle | None") -> Check:
    """Test the run's access rules: Zenoh denies silently, so each right is tried."""
    answers: queue.SimpleQueue[bool] = queue.SimpleQueue()

    def on_echo(_sample: zenoh.Sample) -> None:
        answers.put(True)

    subscriber = session.declare_subscriber(f"{key_names.TOPIC}echo/{name}", Callback(on_echo, indirect=False))
    ask(session, name, ECHO)
    try:
        is_receiving = answers.get(timeout=PATIENCE_S if bundle is None or bundle.role == "observer" else PATIENCE_S / 4)
    except queue.Empty:
        is_receiving = False
    undeclare(subscriber)
    speaks = ask(session, _SOMEBODY) is not None
    topics = "receives the topics of the run" if is_receiving else "does not receive the topics of the run"
    others = "may act for other vehicles" if speaks else "acts only for itself"
    if bundle is None:
        return ("access", True, f"no certificates are required: anyone in reach of this endpoint {topics} and {others}")
    right = is_receiving == (bundle.role == "observer") and not speaks
    return ("access", right, f"'{name}' {topics} and {others}" + ("" if right else f", which is wrong for a {bundle.role}"))
