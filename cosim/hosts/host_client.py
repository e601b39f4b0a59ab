"""Client side of an agent host: answers questions (`Desk`) and dials in to a run over Eclipse Zenoh (`serve`)."""

import math
import queue
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import zenoh
from zenoh.handlers import Callback

from vcmvsp.cosim.agent import Agent, AgentInfo, AgentSpec
from vcmvsp.cosim.config.source_code import fingerprint
from vcmvsp.cosim.errors import FederateError, Interrupted, UsageError, VcmvspError, words_of
from vcmvsp.cosim.federate import Federate
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.transport import access_control, endpoints, key_names, zenoh_session
from vcmvsp.cosim.transport.zenoh_session import UNIX, client, common_names, threads, undeclare

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle

JOIN_S = 3.0  # s: on a busy machine a new run may listen before it accepts join requests
_NO_TIMEOUT_S = 1e6  # a host waits for its run without limit
_DIAL_S = 0.1
_LOOK_S = 1.0
_READS = "(rx: (handover: app))"
"""Zenoh's receive executor in a host: the thread that waits for the socket also reads and calls back. By default Zenoh wakes
another thread for each message, a tenth of an exchange. Callbacks of a host only enqueue, so nothing blocks that thread.
Another thread writes, so the link stays alive while a callback waits for an agent that holds Python's lock.
"""
Secret = str | None
"""Secret of a run; empty: the run requires none."""
NO_RUN = "no run of this user listens there; add --secret FILE or --insecure to join a run of another user"
_RETRY = {"period_init_ms": 100, "period_max_ms": 500}  # reconnection of a broken link


class BuildsHost(Protocol):
    """Factory of a `Desk`'s federate: `agents.federate.AgentHost`, without a dependency on that package."""

    def __call__(self, name: str, specs: Sequence[AgentSpec], objects: Mapping[str, Agent] | None = None, /) -> "HostFederate":
        """A federate with these agents; ``objects``: existing agents, by vehicle."""


class HostFederate(Federate, Protocol):
    """A federate that describes the agents it holds."""

    agents: tuple[AgentInfo, ...]


class Desk:
    """Host server: answers questions in order with the federate that it builds."""

    def __init__(self, builds: BuildsHost) -> None:
        self._builds = builds
        self._federate: HostFederate | None = None
        self.ended: str | None = None  # reason for which no more questions come
        self.failure: VcmvspError | None = None  # error in this host that ended it

    def handle(self, question: bytes | memoryview) -> bytes:
        """The answer to a question; any error becomes a `Failed`."""
        try:
            return protocol.encode(self._answer(protocol.questions.decode(question)))
        except VcmvspError as error:
            self.failure = error
        except KeyboardInterrupt:
            self.failure = Interrupted("interrupted at its host")
        except BaseException as error:  # a host must answer, also if an agent raises something unusual
            details = "".join(traceback.format_exception(error))
            self.failure = FederateError("host", words_of(error), details=details)
        self.ended = str(self.failure)
        return protocol.encode(protocol.Failed.of(self.failure))

    def _answer(self, question: protocol.Question) -> protocol.Answer:
        if isinstance(question, protocol.Build):
            if self._federate is not None:
                raise FederateError("host", "received a second build request")
            self._federate = self._builds("host", question.specs)
            code = {spec.vehicle: fingerprint(spec) for spec in question.specs}
            return protocol.Built(self._federate.agents, self._federate.reads, self._federate.latest, code)
        if isinstance(question, protocol.End):
            self.ended = question.reason
            self.close()
            return protocol.Ended()
        if self._federate is None:
            raise FederateError("host", "received a step before a build request")
        if isinstance(question, protocol.Begin):
            self._federate.start(question.run)
            return protocol.Stepped([])
        step = self._federate.step(question.now_ns, question.inbox)
        return protocol.Stepped(list(step.events))

    def close(self) -> None:
        """Close the federate, once."""
        federate, self._federate = self._federate, None
        if federate is not None:
            federate.close()


def serve(
    hello: Callable[[str], protocol.Hello],  # makes the join request, given the host's own id
    desk: Desk,
    endpoint: str,  # of the hub, e.g. ``tls/192.168.1.10:7447``; the hub may start later
    *,
    bundle: "Bundle | None" = None,  # certificate of this host; None: plain TCP
    secret: Secret = None,  # as in `dial`
    on_state: Callable[[str], None] = lambda _: None,
) -> str:
    """Run a host: dial in, wait for a run, answer its questions until it ends; returns the reason for the end.

    Raises:
        UsageError: the endpoint is invalid, or the hub refuses this host.
        FederateError: an agent of this host failed, or the run is lost.
    """
    name = key_names.OPEN if bundle is None else bundle.name
    with threads(_READS):
        session = dial(endpoint, bundle, on_state, secret=secret)
    with session:
        host = str(session.zid())
        questions: queue.SimpleQueue[zenoh.Sample | bool] = queue.SimpleQueue()
        key = key_names.host_key(name, host, "ask")
        subscriber = session.declare_subscriber(key, Callback(questions.put, indirect=False))
        publisher = session.declare_publisher(key_names.answer_key(key), congestion_control=zenoh.CongestionControl.BLOCK)
        token = session.liveliness().declare_token(key_names.host_key(name, host, "alive"))

        def on_hub(sample: zenoh.Sample) -> None:
            questions.put(sample.kind == zenoh.SampleKind.PUT)

        listens = Callback(on_hub, indirect=False)
        watch = session.liveliness().declare_subscriber(key_names.HUB_ALIVE, listens, history=True)
        welcome = _join(session, name, hello(host))
        on_state("joined; waiting for the run to begin")
        try:
            _answer(questions, desk, publisher, session, welcome, on_state)
            if desk.failure is not None:
                raise desk.failure
            return desk.ended or ""
        finally:
            desk.close()
            undeclare(watch, token, subscriber, publisher)


def _answer(
    questions: "queue.SimpleQueue[zenoh.Sample | bool]",
    desk: Desk,
    publisher: zenoh.Publisher,
    session: zenoh.Session,
    welcome: protocol.Welcome,
    on_state: Callable[[str], None],
) -> None:
    """Answer questions until the run ends; waits for an unreachable run, and does not act twice on repeated questions.

    The last answer may be lost, too: the host stays until the run expects no more answers or does not return in time.
    """
    answers, patience_s = _Answers(desk), welcome.patience_s
    hub = hub_of(session)
    is_reachable = True
    while not answers.known:
        question = _next(questions, _LOOK_S if is_reachable and desk.ended is None else patience_s)
        if question is None and desk.ended is not None:
            return
        if question is None and not is_reachable:
            raise FederateError("the run", "is gone: its process ended or the connection broke")
        if question is None or isinstance(question, bool):
            # Presence of the hub; a host that was suspended for a while may have missed a change.
            was_reachable, is_reachable = is_reachable, hub_of(session) != "" if question is None else question
            if was_reachable and not is_reachable and desk.ended is None:
                on_state(f"the run is unreachable; waiting for at most {patience_s:g} s")
            if is_reachable and desk.ended is None and hub_of(session) not in (hub, ""):
                raise FederateError("the run", "is gone: another run listens there now; start this host again")
        elif answer := answers.to(question.payload.to_bytes()):
            publisher.put(protocol.sealed(welcome.seal, answer) if welcome.seal else answer)


class _Answers:
    """The answers of a desk: in order, and repeated for repeated questions.

    A lost question may arrive after its successor. The successor then gets no answer, and the run repeats both in order.
    """

    def __init__(self, desk: Desk) -> None:
        self._desk = desk
        self._recent: dict[int, bytes] = {}  # answers that the run may ask for again
        self._last = 0
        self.known = False  # the run has the last answer, or does not want it

    def to(self, content: bytes) -> bytes | None:
        """The answer to a message; None: no answer is due."""
        if len(content) < protocol.numbers.size:
            return None  # not a question of a run
        number, oldest = protocol.numbers.unpack_from(content)
        while self._recent and next(iter(self._recent)) < oldest:
            del self._recent[next(iter(self._recent))]
        if self._desk.ended is not None:
            self.known = oldest > self._last
        elif number == self._last + 1:
            self._recent[number] = protocol.number.pack(number) + self._desk.handle(
                memoryview(content)[protocol.numbers.size :]
            )
            self._last = number
        return self._recent.get(number)


def _next(questions: "queue.SimpleQueue[zenoh.Sample | bool]", seconds: float) -> "zenoh.Sample | bool | None":
    try:
        return questions.get(timeout=seconds)
    except queue.Empty:
        return None


def hub_of(session: zenoh.Session) -> str:
    """The id of the hub's session; empty: the hub is unreachable."""
    return "".join(str(each) for each in session.info.routers_zid()[:1])


def dial(endpoint: str, bundle: "Bundle | None", on_state: Callable[[str], None], *, secret: Secret = None) -> zenoh.Session:
    """A client session to the hub, as soon as it listens; attempts are short, so that Ctrl-C works in between.

    Args:
        bundle: certificate of this machine; None: plain TCP.
        secret: secret of the run, where there is no certificate; None: the one that this user's run has left on this machine.
    """
    last = ""
    while True:
        secure = dialling(endpoint, bundle, secret)
        try:
            if secure is not None:  # else any process may listen there
                session = client(endpoint, secure, f"cannot connect to '{endpoint}'", retry=_RETRY)
                break
        except UsageError as error:
            if "Unable to connect" not in str(error):
                raise
        refusal = None if endpoint.startswith(UNIX) else zenoh_session.diagnose(endpoint, bundle)
        if refusal is not None and refusal.final:
            raise UsageError(f"cannot join the run at {endpoint}: {refusal.why}")
        unknown = "" if bundle else NO_RUN
        why = refusal.why if refusal else unknown
        status = f"waiting for a run at {endpoint}" + (f": {why}" if why else "")
        if status != last:
            on_state(status)
            last = status
        time.sleep(_DIAL_S)
    if bundle is not None:
        try:
            access_control.check_hub(common_names(session))
        except UsageError:
            session.close()  # type: ignore[no-untyped-call]
            raise
    return session


def dialling(endpoint: str, bundle: "Bundle | None", secret: Secret) -> dict[str, Any] | None:
    """Client part of Zenoh's configuration, or None without certificate and secret (arguments as of `dial`)."""
    if bundle is not None:
        return access_control.machine_security(bundle)
    password = endpoints.find_secret(endpoint) if secret is None else secret
    if password is None:
        return None
    return access_control.client_secret(password) if password else {}


def _join(session: zenoh.Session, name: str, hello: protocol.Hello) -> protocol.Welcome:
    greeting = protocol.encode(hello)
    if len(greeting) > access_control.MAX_JOIN:
        raise UsageError(f"join request too long ({len(greeting)} bytes; at most {access_control.MAX_JOIN}): use fewer --set")
    last = math.inf if hello.token else time.monotonic() + JOIN_S  # a host that the run has started ends with it
    while True:
        for reply in session.get(key_names.join_key(name), payload=greeting, timeout=_NO_TIMEOUT_S):
            if reply.ok is not None:
                welcome = protocol.welcomes.decode(reply.ok.payload.to_bytes())
                if welcome.refused:
                    raise UsageError(f"the run rejects this host: {welcome.refused}")
                return welcome
        if time.monotonic() > last:
            break
        time.sleep(_DIAL_S)
    if name == key_names.OPEN:
        raise FederateError("the run", "ended before it admitted this host")
    raise UsageError(access_control.silence(name))
