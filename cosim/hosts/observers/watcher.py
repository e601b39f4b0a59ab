"""Watching a run from elsewhere: hear what it shows, and ask what run it is (the hub's end: `cosim.hosts.event_publisher`)."""

import queue
import time
from collections.abc import Callable, Generator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.hosts.event_publisher import About, stamp
from vcmvsp.cosim.hosts.host_client import dial, hub_of
from vcmvsp.cosim.transport import access_control, key_names, tls_diagnosis
from vcmvsp.cosim.util.documents import read_json

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle

PATIENCE_S = 2.0  # a run that is out of reach may come back, and one that has just begun to listen may not answer yet
BACKLOG = 100_000  # events that wait here for a slow terminal; what is more is lost
POLL_S = 0.05


class Seen(NamedTuple):
    """An event of the run as it arrived."""

    time_ns: int  # simulated
    topic: str  # e.g. car2/command
    type: str  # the tag of the value, e.g. velocity
    payload: bytes  # JSON

    @property
    def value(self) -> Any:
        """The value, of lists, mappings, numbers and strings; None: it cannot be read."""
        try:
            return read_json(self.payload)
        except (ValueError, RecursionError):
            return None


def watch(
    endpoint: str,
    topics: Sequence[str] = ("**",),
    *,
    bundle: "Bundle | None" = None,
    secret: str | None = None,
    every_s: float = 0.0,
    on_state: Callable[[str], None] = lambda _: None,
) -> Generator[list[Seen], None, None]:
    """What a run shows, until it ends. One that is not there yet is waited for.

    Args:
        endpoint: where the run listens.
        topics: key expressions of what to hear, e.g. ``car2/*``.
        bundle: certificate of this observer; None: plain TCP.
        secret: of the run, without a certificate, as of `cosim.hosts.host_client.dial`.
        every_s: collect for so long before giving what has come.
        on_state: told what is being waited for, and how it ended.

    Raises:
        UsageError: the run does not let this observer in, or something is wrong with the arguments.
    """
    wanted = [_expression(topic) for topic in topics]
    if bundle is not None and bundle.role != "observer":
        owner = ", ".join(bundle.vehicles)
        raise UsageError(f"{bundle.path}: is for the host of {owner}; to watch use what 'vcmvsp keys observer NAME' makes")
    with dial(endpoint, bundle, on_state, secret=secret) as session:
        name = key_names.OPEN if bundle is None else bundle.name
        about = greeted(session, name)
        inbox: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
        lost = 0

        def on_sample(sample: zenoh.Sample) -> None:
            nonlocal lost
            if inbox.qsize() < BACKLOG:
                inbox.put(sample)
            else:
                lost += 1

        run = _Presence(session, endpoint, bundle)
        for key in wanted:
            session.declare_subscriber(key, Callback(on_sample, indirect=False))
        on_state(f"watching {endpoint}: {which(about)}")
        over = False
        while not over:
            over = run.is_over()  # asked first: what has come until then is given yet
            if batch := _batch(inbox, every_s):
                yield batch
        on_state("the run has ended, or is out of reach" + (f"; {lost} events came too fast to be shown" if lost else ""))


class _Presence:
    """Whether the run is still there: its token, and, once that has gone, whoever listens at its endpoint."""

    def __init__(self, session: zenoh.Session, endpoint: str, bundle: "Bundle | None") -> None:
        self._session, self._endpoint, self._bundle = session, endpoint, bundle
        self._hub = hub_of(session)
        self._gone_at: float | None = None  # its token
        self._cut_at: float | None = None  # its session
        changes = Callback(self._on_token, indirect=False)
        session.liveliness().declare_subscriber(key_names.HUB_ALIVE, changes, history=True)

    def is_over(self) -> bool:
        """Whether the run has ended, or is out of reach for good."""
        present = hub_of(self._session)
        if present not in (self._hub, ""):
            return True  # another one listens there now
        if present:
            self._cut_at = None
        elif self._cut_at is None:
            self._cut_at = time.monotonic()
        since = self._gone_at or self._cut_at
        if since is None:
            return False
        refusal = tls_diagnosis.diagnose(self._endpoint, self._bundle)
        hopeless = (refusal is not None and refusal.final) or time.monotonic() > since + PATIENCE_S
        if not hopeless:
            time.sleep(POLL_S)
        return hopeless and (self._gone_at or self._cut_at) is not None  # it may have come back meanwhile

    def _on_token(self, sample: zenoh.Sample) -> None:
        self._gone_at = None if sample.kind == zenoh.SampleKind.PUT else time.monotonic()


def _batch(inbox: "queue.SimpleQueue[zenoh.Sample]", every_s: float) -> list[Seen]:
    """What comes within so long; without a length, what is there as soon as there is something."""
    found: list[Seen] = []
    last = time.monotonic() + (every_s or POLL_S)
    while (left_s := last - time.monotonic()) > 0.0:
        try:
            sample = inbox.get(timeout=left_s)
        except queue.Empty:
            break
        if seen := _seen(sample):
            found.append(seen)
        if not every_s and inbox.empty():
            break
    return found


def _seen(sample: zenoh.Sample) -> Seen | None:
    key, when = str(sample.key_expr), sample.attachment
    if "*" in key or when is None or len(when) != stamp.size:
        return None  # nothing that a run has said
    (time_ns,) = stamp.unpack(when.to_bytes())
    kind = str(sample.encoding).rpartition(";")[2]
    return None if kind == "echo" else Seen(time_ns, key.removeprefix(key_names.TOPIC), kind, sample.payload.to_bytes())


def _expression(topic: str) -> str:
    try:
        return str(zenoh.KeyExpr(key_names.TOPIC + topic))
    except zenoh.ZError as error:
        raise UsageError(f"--topic {topic}: must be a key like car2/command, with * for one part and ** for many") from error


def ask(session: zenoh.Session, name: str, payload: bytes = b"") -> About | None:
    """What the run says of itself on the key of this name; None: it says nothing."""
    for reply in session.get(key_names.about_key(name), payload=payload, timeout=PATIENCE_S):
        if reply.ok is not None:
            try:
                answer: About = read_json(reply.ok.payload.to_bytes(), About)
            except ValueError:
                return None
            return answer
    return None


def greeted(session: zenoh.Session, name: str) -> About:
    """The same, from a run that may just have begun to listen; `UsageError` if it does not answer."""
    last = time.monotonic() + PATIENCE_S
    while (about := ask(session, name)) is None:
        if time.monotonic() > last:
            raise UsageError(_no_answer(name))
        time.sleep(POLL_S)
    return about


def _no_answer(name: str) -> str:
    if name == key_names.OPEN:
        return "what listens there does not say what run it is: use the same vcmvsp version at both ends"
    return access_control.silence(name)


def which(about: About) -> str:
    """A run in a few words."""
    length = "" if about.duration_s is None else f" of {about.duration_s:g} s"
    when = "not begun yet" if about.time_ns is None else f"now at {about.time_ns / 1e9:.1f} s{length}"
    return f"{about.scenario or 'a run'} ({len(about.vehicles)} vehicles), {when}"
