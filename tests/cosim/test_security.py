"""The network's rules with real certificates and real sessions: who gets in, who can say and hear what, and who is told why."""

import contextlib
import datetime as dt
import json
import os
import queue
import random
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from zenoh.handlers import Callback

from cosim import authority, certificates, signing
from cosim.certificates import Bundle, Keys
from cosim.errors import UsageError
from cosim.transport import diagnosis, key_names, security
from cosim.transport.endpoints import endpoint_rules
from cosim.transport.security import merge

QUIET: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}},
}
TOPIC = "vcmvsp/topic/car2/state"
PATIENCE_S = 20.0
EXCHANGED = (b"question", b"answer")  # what a run and its hosts say to one another


def start(config: dict[str, Any]) -> zenoh.Session:
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def direct(function: Callable[[Any], object]) -> Any:
    return Callback(function, indirect=False)


def answering(host: zenoh.Session, key: str, answer: Callable[[bytes], bytes] = lambda _: b"answer") -> None:
    """Answer what the hub asks under this key as a host does: not in a thread of Zenoh's, which has to send it, too."""
    says = host.declare_publisher(key_names.answer_key(key), congestion_control=zenoh.CongestionControl.BLOCK)
    asked: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    host.declare_subscriber(key, direct(asked.put))

    def work() -> None:
        with contextlib.suppress(zenoh.ZError):  # the session has been closed
            while True:
                says.put(answer(asked.get().payload.to_bytes()))

    threading.Thread(target=work, daemon=True).start()


def reply(query: zenoh.Query, what: bytes = b"ok") -> None:
    with query:
        query.reply(str(query.key_expr), what)


def until(condition: Callable[[], object]) -> None:
    last = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < last, "it never came true"
        time.sleep(0.005)


class Hub:
    """A router with the rules, which answers greetings and counts whatever gets through to it."""

    def __init__(self, rules: dict[str, Any], endpoints: tuple[str, ...] = ("tls/127.0.0.1:0",)) -> None:
        self.seen: Counter[str] = Counter()
        own = {"mode": "router", "listen": {"endpoints": list(endpoints)}, "adminspace": {"enabled": True}}
        self.session = start(merge(QUIET, own, rules))
        self.endpoints = self._locators()
        self.endpoint = self.endpoints[0]
        self._links: list[zenoh.LinkEvent] = []
        self.session.info.declare_link_events_listener(direct(self._links.append))
        for key in (key_names.JOIN, key_names.ABOUT):
            self.session.declare_queryable(key, direct(self._greeted))
        self._token = self.session.liveliness().declare_token(key_names.HUB_ALIVE)
        watch = direct(lambda sample: self.seen.update([f"token {sample.key_expr}"]))
        self.session.liveliness().declare_subscriber("vcmvsp/**", watch)
        self.session.declare_subscriber("**", direct(self._heard))

    def ask(self, name: str, host: zenoh.Session, question: bytes = b"question", within_s: float = 1.0) -> list[bytes]:
        """The answer of a host, if one comes in time."""
        key, box = key_names.host_key(name, str(host.zid()), "ask"), queue.SimpleQueue[bytes]()
        hears = self.session.declare_subscriber(
            key_names.answer_key(key), direct(lambda sample: box.put(sample.payload.to_bytes()))
        )
        self.session.put(key, question)
        try:
            return [box.get(timeout=within_s)]
        except queue.Empty:
            return []
        finally:
            hears.undeclare()  # type: ignore[no-untyped-call]

    def links(self, name: str) -> list[bool]:
        """True for each link of this name that came, False for each that went."""
        return [each.kind == zenoh.SampleKind.PUT for each in self._links if each.link.auth_identifier == name]

    def _heard(self, sample: zenoh.Sample) -> None:
        said = sample.payload.to_bytes()
        if not said.isdigit() and not said.startswith(EXCHANGED):
            self.seen.update([f"sample {sample.payload.to_string()}"])

    def _greeted(self, query: zenoh.Query) -> None:
        said = query.payload.to_bytes() if query.payload else b""
        self.seen.update([f"greeting {query.key_expr} {said[:5].decode()}"])
        reply(query, b"welcome")

    def _locators(self) -> list[str]:
        replies = self.session.get(f"@/{self.session.zid()}/router")
        (found,) = [json.loads(each.ok.payload.to_string())["locators"] for each in replies if each.ok]
        return list(found)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    folder = tmp_path_factory.mktemp("network") / "keys"
    authority.init(folder)
    for name in ("car2", "car3", "gone"):
        authority.issue(folder, name, [name])
    authority.issue(folder, "anna")
    authority.revoke(folder, "gone")
    return certificates.load(folder)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    """Another authority, which has given a certificate of the same name."""
    folder = tmp_path_factory.mktemp("foreign") / "keys"
    authority.init(folder)
    authority.issue(folder, "car2", ["car2"])
    return certificates.load(folder)


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    with contextlib.ExitStack() as closing:
        yield closing


@pytest.fixture
def hub(keys: Keys, stack: contextlib.ExitStack) -> Hub:
    made = Hub(security.hub_security(keys))
    stack.callback(made.session.close)
    return made


def bundle(keys: Keys, name: str) -> Bundle:
    return certificates.load_bundle(keys.folder / f"{name}.keys")


def dial(endpoint: str, machine: Bundle | None, mode: str = "client") -> zenoh.Session:
    own = {"mode": mode, "listen": {"endpoints": []}, "connect": {"endpoints": [endpoint], "timeout_ms": 0}}
    return start(merge(QUIET, own, security.machine_security(machine) if machine else {}))


def greet(session: zenoh.Session, name: str, payload: bytes = b"hello") -> list[bytes]:
    replies = session.get(key_names.join_key(name), payload=payload, timeout=PATIENCE_S)
    return [each.ok.payload.to_bytes() for each in replies if each.ok]


def inquire(session: zenoh.Session, name: str, payload: bytes = b"about") -> list[bytes]:
    replies = session.get(key_names.about_key(name), payload=payload, timeout=PATIENCE_S)
    return [each.ok.payload.to_bytes() for each in replies if each.ok]


def lasting(folder: Path, name: str, seconds: float, monkeypatch: pytest.MonkeyPatch) -> Bundle:
    """A certificate that ends so long from now."""
    with monkeypatch.context() as patch:
        real = signing.now
        patch.setattr(signing, "now", lambda: real() + dt.timedelta(days=-1, seconds=seconds))
        return authority.issue(folder, name, [name], days=1)


# --- the door ---


def test_who_has_a_certificate_comes_in_and_both_know_the_other(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        security.check_hub(link.auth_identifier for link in host.info.links())
        until(lambda: hub.links("car2"))
        assert greet(host, "car2") == [b"welcome"]
    assert diagnosis.diagnose(hub.endpoint, bundle(keys, "car2")) is None


def refused(endpoint: str, machine: Bundle | None) -> str:
    """Why nothing came of dialling; the reason is found, and says that trying again is no use."""
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        dial(endpoint, machine)
    found = diagnosis.diagnose(endpoint, machine)
    assert found is not None
    assert found.final
    return found.why


def test_a_file_of_another_authority_is_refused(hub: Hub, keys: Keys, foreign: Keys) -> None:
    other = bundle(foreign, "car2")
    assert "another authority than" in refused(hub.endpoint, other)
    half = foreign.folder / "half.keys"  # which trusts the run, but is not trusted by it
    half.write_text(other.key_pem + other.certificate_pem + keys.ca_pem)
    crossed = msgspec.structs.replace(other, path=half, ca_pem=keys.ca_pem)
    assert "the run does not" in refused(hub.endpoint, crossed)


def test_an_expired_certificate_is_refused_though_the_clock_of_its_owner_is_late(
    hub: Hub, keys: Keys, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = lasting(keys.folder, "old", -5.0, monkeypatch)
    assert "by the clock of the run's machine" in refused(hub.endpoint, old)


def test_without_a_certificate_nobody_comes_in(hub: Hub, keys: Keys) -> None:
    assert "wants certificates" in refused(hub.endpoint.replace("tls/", "tcp/"), None)
    rules = security.machine_security(bundle(keys, "car2"))
    for part in ("connect_private_key_base64", "connect_certificate_base64", "enable_mtls"):
        del rules["transport"]["link"]["tls"][part]
    dialling = {"mode": "client", "connect": {"endpoints": [hub.endpoint], "timeout_ms": 0}}
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        start(merge(QUIET, dialling, rules))
    assert hub.links("car2") == []


def test_a_run_under_a_name_that_its_certificate_has_not_is_refused(keys: Keys, stack: contextlib.ExitStack) -> None:
    elsewhere = Hub(security.hub_security(keys), ("tls/127.0.0.2:0",))
    stack.callback(elsewhere.session.close)
    why = refused(elsewhere.endpoint, bundle(keys, "car2"))
    assert why == "the run's certificate is not for '127.0.0.2'; on its machine: vcmvsp keys hub --name 127.0.0.2 --keys DIR"


def test_a_host_cannot_pose_as_a_run(keys: Keys, stack: contextlib.ExitStack) -> None:
    rules = security.hub_security(keys)
    posing = bundle(keys, "car3")
    own = {"listen_private_key_base64": posing.key_pem, "listen_certificate_base64": posing.certificate_pem}
    rules = merge(rules, {"transport": {"link": {"tls": {name: security._base64(pem) for name, pem in own.items()}}}})
    impostor = Hub(rules)
    stack.callback(impostor.session.close)
    assert "no run: its certificate is that of a host" in refused(impostor.endpoint, bundle(keys, "car2"))
    with pytest.raises(UsageError, match="what answers there is 'car3', not a run"):
        security.check_hub(["hub", "car3"])


def test_a_run_whose_certificate_has_expired_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    folder = authority.init(tmp_path / "keys").folder
    machine = authority.issue(folder, "car2", ["car2"])
    with monkeypatch.context() as patch:
        real = signing.now
        patch.setattr(signing, "now", lambda: real() - dt.timedelta(days=2))
        authority.renew_hub(folder, days=1)
    late = Hub(security.hub_security(certificates.load(folder)))
    stack.callback(late.session.close)
    assert "has expired; on its machine: vcmvsp keys hub" in refused(late.endpoint, machine)


def test_tls_to_a_run_without_is_refused(keys: Keys, stack: contextlib.ExitStack) -> None:
    plain = Hub({}, ("tcp/127.0.0.1:0",))
    stack.callback(plain.session.close)
    endpoint = plain.endpoint.replace("tcp/", "tls/")
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        dial(endpoint, bundle(keys, "car2"))
    silent = "what listens there does not answer in TLS; is it a run with --listen tcp/...?"
    assert diagnosis.diagnose(endpoint, bundle(keys, "car2")) == diagnosis.Refusal(silent, final=False)
    assert diagnosis.diagnose(plain.endpoint, None) is None


def test_where_nobody_listens_one_may_wait(keys: Keys) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    for machine, protocol in ((bundle(keys, "car2"), "tls"), (None, "tcp")):
        found = diagnosis.diagnose(f"{protocol}/127.0.0.1:{port}", machine)
        assert found == diagnosis.Refusal("nobody listens there (Connection refused)", final=False)
        found = diagnosis.diagnose(f"{protocol}/nobody.invalid:{port}", machine)
        assert found == diagnosis.Refusal("no machine is known by the name 'nobody.invalid'", final=False)


HUB_PROCESS = """
import json, sys, zenoh
from pathlib import Path
from cosim import certificates
from cosim.transport import key_names, security
zenoh.init_log_from_env_or(security.LOG)
folder, endpoint = sys.argv[1:]
own = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": {"delay": 0, "multicast": {"enabled": False}}}
own["transport"] = {"shared_memory": {"enabled": False}}
rules = security.hub_security(certificates.load(Path(folder)))
with zenoh.open(zenoh.Config.from_json5(json.dumps(security.merge(own, rules)))) as session:
    door = session.declare_queryable(key_names.JOIN)
    print("up", flush=True)
    for query in door:
        with query:
            query.reply(str(query.key_expr), b"welcome")
"""


@contextlib.contextmanager
def hub_process(*arguments: str, before: tuple[str, ...] = ()) -> Iterator["subprocess.Popen[str]"]:
    environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    environment["PYTHONPATH"] = str(Path(certificates.__file__).parent.parent)
    process = subprocess.Popen(
        [*before, sys.executable, "-c", HUB_PROCESS, *arguments], stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def test_the_run_logs_whom_it_turns_away_and_why(keys: Keys, foreign: Keys, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    mixed = msgspec.structs.replace(bundle(foreign, "car2"), ca_pem=keys.ca_pem)
    expired = lasting(keys.folder, "older", -5.0, monkeypatch)
    with hub_process(str(keys.folder), f"tls/127.0.0.1:{port}") as process:
        for machine, protocol in ((mixed, "tls"), (expired, "tls"), (None, "tcp")):
            with pytest.raises(zenoh.ZError):
                dial(f"{protocol}/127.0.0.1:{port}", machine)
        with dial(f"tls/127.0.0.1:{port}", bundle(keys, "car2")) as host:
            assert greet(host, "car2") == [b"welcome"]
        process.kill()
        said, _ = process.communicate()
    for reason in ("UnknownIssuer", "certificate expired", "corrupt message"):
        assert reason in said


def test_a_link_ends_with_its_certificate(hub: Hub, keys: Keys, monkeypatch: pytest.MonkeyPatch) -> None:
    ending = lasting(keys.folder, "ending", 4.0, monkeypatch)
    with dial(hub.endpoint, ending):
        until(lambda: hub.links("ending") == [True])
        until(lambda: hub.links("ending") == [True, False])


def test_three_hundred_connections_of_garbage_hurt_nobody(keys: Keys, stack: contextlib.ExitStack) -> None:
    # Zenoh pauses a listener for 0.1 s after each handshake that fails: with a single one this would take half a minute.
    hub = Hub(security.hub_security(keys), ("tls/127.0.0.1:0",) * 20)
    stack.callback(hub.session.close)
    inside = stack.enter_context(dial(hub.endpoint, bundle(keys, "car2")))
    key = key_names.host_key("car2", str(inside.zid()), "ask")
    answering(inside, key)
    assert greet(inside, "car2") == [b"welcome"]
    draw, silent = random.Random(1), []
    for number in range(300):
        _, port = hub.endpoints[number % len(hub.endpoints)].rsplit(":", 1)
        connection = socket.create_connection(("127.0.0.1", int(port)), timeout=PATIENCE_S)
        kind = number // len(hub.endpoints) % 3
        with contextlib.suppress(OSError):  # the hub may have hung up already
            connection.sendall((b"", draw.randbytes(300), b"\x16\x03\x01\x02\x00\x01" + draw.randbytes(511))[kind])
        silent.append(connection)
        if kind:
            connection.close()
        assert hub.ask("car2", inside) == [b"answer"] if number % 20 == 0 else True
    late = None
    while late is None:
        with contextlib.suppress(zenoh.ZError):
            late = stack.enter_context(dial(hub.endpoints[-1], bundle(keys, "car3")))
    assert greet(late, "car3") == [b"welcome"]
    assert hub.ask("car2", inside) == [b"answer"]
    assert set(hub.seen) == {"greeting vcmvsp/join/car2 hello", "greeting vcmvsp/join/car3 hello"}
    for connection in silent:
        connection.close()


# --- the rules ---


ALL = frozenset({"greeted", "answered", "alive", "hub seen", "told", "topics", "anna told", "anna sees hub"})


class Stage:
    """A hub, the host of car2 and the observer anna, as a run has them; all they get is counted."""

    def __init__(self, keys: Keys, rules: dict[str, Any], stack: contextlib.ExitStack) -> None:
        self.seen: Counter[str] = Counter()
        self.hub = Hub(rules)
        stack.callback(self.hub.session.close)
        self.host = stack.enter_context(dial(self.hub.endpoint, bundle(keys, "car2")))
        self.anna = stack.enter_context(dial(self.hub.endpoint, bundle(keys, "anna")))
        zid = str(self.host.zid())
        self.keys = key_names.host_key("car2", zid, "ask"), key_names.host_key("car2", zid, "alive")
        answering(self.host, self.keys[0], self._asked)
        self._token = self.host.liveliness().declare_token(self.keys[1])
        watch = direct(lambda sample: self.seen.update([f"car2 sees hub {sample.kind}"]))
        self.host.liveliness().declare_subscriber(key_names.HUB_ALIVE, watch, history=True)
        look = direct(lambda sample: self.seen.update([f"anna sees hub {sample.kind}"]))
        self.anna.liveliness().declare_subscriber(key_names.HUB_ALIVE, look, history=True)
        hear = direct(lambda sample: self.seen.update([f"anna hears {sample.payload.to_string()}"]))
        self.anna.declare_subscriber(key_names.TOPICS, hear)

    def _asked(self, question: bytes) -> bytes:
        self.seen.update([f"car2 asked {question.decode()}"])
        return b"answer"

    def everything(self, expected: frozenset[str] = ALL) -> set[str]:
        """What works of all that a run needs; of what is expected, as soon as it does."""
        checks: dict[str, Callable[[], object]] = {
            "greeted": lambda: greet(self.host, "car2") == [b"welcome"],
            "answered": lambda: self.hub.ask("car2", self.host) == [b"answer"],
            "alive": lambda: self.hub.seen[f"token {self.keys[1]}"],
            "hub seen": lambda: self.seen[f"car2 sees hub {zenoh.SampleKind.PUT}"],
            "told": lambda: inquire(self.host, "car2") == [b"welcome"],
            "topics": self._heard,
            "anna told": lambda: inquire(self.anna, "anna") == [b"welcome"],
            "anna sees hub": lambda: self.seen[f"anna sees hub {zenoh.SampleKind.PUT}"],
        }
        for name in expected:
            until(checks[name])
        settle()
        return {name for name, check in checks.items() if name in expected or check()}

    def _heard(self) -> int:
        self.hub.session.put(TOPIC, b"truth")
        return self.seen["anna hears truth"]


def settle() -> None:
    """Time for what should not arrive to arrive; the test without rules shows that it is enough."""
    time.sleep(0.2)


def test_a_run_works_under_the_rules(keys: Keys, stack: contextlib.ExitStack) -> None:
    stage = Stage(keys, security.hub_security(keys), stack)
    assert stage.everything() == ALL


def _grants() -> list[tuple[str, str]]:
    """Every message of every rule of a host and an observer."""
    rules = security._access(["car2"], ["anna"])["rules"]
    return [(rule["id"], message) for rule in rules for message in rule["messages"]]


@pytest.mark.parametrize(("rule", "message"), _grants())
def test_no_rule_allows_more_than_a_run_needs(keys: Keys, stack: contextlib.ExitStack, rule: str, message: str) -> None:
    rules = security.hub_security(keys)
    for each in rules["access_control"]["rules"]:
        if each["id"] == rule:
            each["messages"] = [other for other in each["messages"] if other != message] or ["delete"]
    needs = {
        "car2/greets": "greeted",
        "car2/is answered": "greeted",
        "car2/listens": "answered",
        "car2/is asked": "answered",
        "car2/is heard": "answered",
        "car2/answers": "answered",
        "car2/is alive": "alive",
        "car2/watches": "hub seen",
        "car2/sees": "hub seen",
        "car2/inquires": "told",
        "car2/is told": "told",
        "anna/listens": "topics",
        "anna/hears": "topics",
        "anna/inquires": "anna told",
        "anna/is told": "anna told",
        "anna/watches": "anna sees hub",
        "anna/sees": "anna sees hub",
    }
    assert Stage(keys, rules, stack).everything(ALL - {needs[rule]}) == ALL - {needs[rule]}


def attack(stage: Stage, session: zenoh.Session, name: str) -> Counter[str]:
    """All that a machine could try to hear others, to speak for them or to pose as the hub; what came of it on its side."""
    got: Counter[str] = Counter()
    zid = str(session.zid())

    def lie(query: zenoh.Query) -> None:
        got.update(["asked"])
        reply(query, b"false")

    for key in (
        "vcmvsp/join/car2",
        key_names.JOIN,
        "vcmvsp/about/car2",
        key_names.ABOUT,
        "**",
        stage.keys[0],
        "vcmvsp/host/*/*/ask",
        "vcmvsp/hub/*",
    ):
        got.update(f"reply on {key}" for each in session.get(key, payload=b"evil", timeout=1.0) if each.ok)
    for key in ("vcmvsp/host/**", stage.keys[1]):
        found = [str(each.ok.key_expr) for each in session.liveliness().get(key, timeout=1.0) if each.ok]
        got.update(f"token {each}" for each in found)
        see = direct(lambda sample: got.update([f"token {sample.key_expr}"]))
        session.liveliness().declare_subscriber(key, see, history=True)
    tokens = [key_names.host_key("car2", zid, "alive"), key_names.HUB_ALIVE, "vcmvsp/hub/*", f"vcmvsp/host/*/{zid}/alive"]
    declared = [session.liveliness().declare_token(key) for key in tokens]
    answer = key_names.answer_key(stage.keys[0])
    for key in (stage.keys[0], "vcmvsp/host/car2/*/ask", "vcmvsp/host/**", "**", "vcmvsp/join/car2", "vcmvsp/about/**"):
        session.declare_queryable(key, direct(lie), complete=True)
    secrets = (stage.keys[0], answer, "vcmvsp/host/**", "vcmvsp/join/**")
    for key in secrets if name == "anna" else (TOPIC, "**", *secrets):
        session.declare_subscriber(key, direct(lambda sample: got.update([f"hears {sample.payload.to_string()}"])))
    settle()
    mine = f"vcmvsp/host/{name}/{zid}/ask", key_names.join_key(name)
    for key in (TOPIC, key_names.TOPICS, "vcmvsp/**", "**", *mine, *secrets, "vcmvsp/host/*/*/answer"):
        session.put(key, b"evil")
    stage.hub.ask("car2", stage.host)
    stage.hub.session.put(TOPIC, b"truth")
    settle()
    for token in declared:
        token.undeclare()  # type: ignore[no-untyped-call]
    settle()
    own = {"hears evil", *(f"token {token}" for token in tokens)}  # a session hears itself
    return Counter({what: count for what, count in got.items() if what not in own})


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
@pytest.mark.parametrize("name", ["car3", "anna", "gone"])
def test_nobody_hears_others_speaks_for_them_or_poses_as_the_run(
    keys: Keys, stack: contextlib.ExitStack, name: str, mode: str
) -> None:
    stage = Stage(keys, security.hub_security(keys), stack)
    session = stack.enter_context(dial(stage.hub.endpoint, bundle(keys, name), mode))
    until(lambda: stage.hub.links(name))
    got = attack(stage, session, name)
    assert stage.everything() == ALL
    assert got == {}
    sees = {f"{who} sees hub {zenoh.SampleKind.PUT}" for who in ("car2", "anna")}
    assert set(stage.seen) == {"car2 asked question", *sees, "anna hears truth"}
    greetings = {f"greeting {key}" for key in ("vcmvsp/join/car2 hello", "vcmvsp/about/car2 about", "vcmvsp/about/anna about")}
    assert set(stage.hub.seen) == {*greetings, f"token {stage.keys[1]}", "sample truth"}


def test_without_the_rules_all_that_would_get_through(keys: Keys, stack: contextlib.ExitStack) -> None:
    rules = security.hub_security(keys)
    del rules["access_control"]
    stage = Stage(keys, rules, stack)
    session = stack.enter_context(dial(stage.hub.endpoint, bundle(keys, "car3")))
    got = attack(stage, session, "car3")
    assert min(got["hears question"], got["hears answer"], got["hears truth"]) > 0
    assert stage.seen["car2 asked evil"] > 0
    assert stage.seen["anna hears evil"] > 0
    assert stage.hub.seen["sample evil"] > 0
    assert stage.hub.seen["greeting vcmvsp/join/car2 evil"] > 0
    assert stage.hub.seen[f"token {key_names.HUB_ALIVE}"] > 0


def test_a_revoked_machine_is_answered_by_silence_that_has_words(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "gone")) as session:
        until(lambda: hub.links("gone"))  # so the run can name it
        assert greet(session, "gone") == []
        assert hub.seen == {}
    assert security.admission(keys, "gone", ["gone"]) == "the certificate of 'gone' has been revoked"
    assert "'gone': its certificate was revoked, or made after the run had begun" in security.silence("gone")


def test_where_all_are_revoked_nobody_is_let_in(keys: Keys, stack: contextlib.ExitStack) -> None:
    nobody = msgspec.structs.replace(keys, index=certificates.Index())
    empty = Hub(security.hub_security(nobody))
    stack.callback(empty.session.close)
    with dial(empty.endpoint, bundle(keys, "car2")) as session:
        assert greet(session, "car2") == []
        session.put(TOPIC, b"evil")
        settle()
    assert empty.seen == {}


def test_the_key_says_whose_vehicles_they_are(keys: Keys) -> None:
    assert security.admission(keys, "car2", ["car2"]) is None
    assert security.admission(keys, "car2", ["car2", "car3"]) == "the certificate of 'car2' is for car2, not for car3"
    assert security.admission(keys, "anna", ["car2"]) == "the certificate of 'anna' is for watching only"
    assert security.admission(keys, "stranger", ["car2"]) == "no certificate was given to 'stranger'"


def test_wildcards_of_ones_own_are_nobodys_key(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        wide = "vcmvsp/host/car2/*/alive"
        token = host.liveliness().declare_token(wide)
        until(lambda: hub.seen[f"token {wide}"])  # Zenoh lets it through: it is within what car2 may say
        assert key_names.speaker(wide) is None
        token.undeclare()  # type: ignore[no-untyped-call]


def test_messages_beyond_the_limits_are_dropped_and_the_link_stays(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        assert greet(host, "car2", b"x" * security.MAX_JOIN) == [b"welcome"]
        assert greet(host, "car2", b"x" * (security.MAX_JOIN + 1)) == []
        key = key_names.host_key("car2", str(host.zid()), "ask")
        answering(host, key, lambda question: b"answer".ljust(int(question)))
        assert greet(host, "car2") == [b"welcome"]
        assert hub.ask("car2", host, b"%d" % (security.MAX_MESSAGE + 1)) == []
        half = security.MAX_MESSAGE // 2
        assert [len(each) for each in hub.ask("car2", host, b"%d" % half, PATIENCE_S)] == [half]
    assert hub.seen == {"greeting vcmvsp/join/car2 xxxxx": 1, "greeting vcmvsp/join/car2 hello": 1}


def test_nobody_reads_the_admin_space_of_the_hub(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        zid = str(hub.session.zid())
        for key in ("@/**", f"@/{zid}/**", f"@/{zid}/router"):
            found = [str(each.ok.key_expr) for each in host.get(key, timeout=1.0) if each.ok]
            assert not [each for each in found if not each.startswith(f"@/{host.zid()}/")]


# --- keys and endpoints ---

names = st.from_regex(r"\A[A-Za-z0-9_-]{1,20}\Z")
zids = st.from_regex(r"\A[0-9a-f]{1,32}\Z")


@given(names, zids)
def test_the_speaker_of_a_key_is_the_name_in_it(name: str, zid: str) -> None:
    assert key_names.speaker(key_names.join_key(name)) == (name, "")
    assert key_names.speaker(key_names.about_key(name)) == (name, "")
    assert key_names.speaker(key_names.host_key(name, zid, "ask")) == (name, zid)
    assert key_names.speaker(key_names.host_key(name, zid, "alive")) == (name, zid)


@given(names, zids, st.sampled_from(["/", "*", "**", "$*", "?", "#", "@", " ", "\n", "\u0661", "/.."]), st.integers(0, 40))
def test_what_could_be_another_key_is_none(name: str, zid: str, evil: str, where: int) -> None:
    bad_name, bad_zid = (each[: where % (len(each) + 1)] + evil + each[where % (len(each) + 1) :] for each in (name, zid))
    for key in (
        key_names.join_key(bad_name),
        key_names.about_key(bad_name),
        f"vcmvsp/host/{bad_name}/{zid}/ask",
        f"vcmvsp/host/{name}/{bad_zid}/alive",
    ):
        assert key_names.speaker(key) is None
    with pytest.raises(ValueError, match="no key of a host"):
        key_names.host_key(name, bad_zid, "ask")


@given(st.text(max_size=60))
def test_any_text_is_a_key_or_none(text: str) -> None:
    assert key_names.speaker(text) is None
    assert key_names.speaker(f"vcmvsp/{text}") is None or "/" in text


@pytest.mark.parametrize("host", ["127.0.0.1", "127.8.9.1", "[::1]", "localhost"])
def test_on_this_machine_plain_tcp_will_do(keys: Keys, host: str) -> None:
    endpoint_rules(f"tcp/{host}:7447")
    endpoint_rules(f"tls/{host}:7447", keys)
    with pytest.raises(UsageError, match="plain TCP uses no certificates: write tls/"):
        endpoint_rules(f"tcp/{host}:7447", keys)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.10", "[::]", "[fe80::1]", "lab.example.org", "localhost.evil.org"])
def test_beyond_this_machine_certificates_are_a_must(keys: Keys, host: str) -> None:
    endpoint_rules(f"tls/{host}:7447", keys)
    endpoint_rules(f"tcp/{host}:7447", insecure=True)
    for side, how in (("run", "--keys DIR (make it with: vcmvsp keys init DIR)"), ("host", "vcmvsp keys vehicle NAME")):
        with pytest.raises(UsageError) as raised:
            endpoint_rules(f"tcp/{host}:7447", side=side)  # type: ignore[arg-type]
        assert f"use tls/{host}:7447 --keys" in str(raised.value)
        assert how in str(raised.value)
        assert "or add --insecure" in str(raised.value)
    with pytest.raises(UsageError, match="TLS needs certificates: add --keys FILE"):
        endpoint_rules(f"tls/{host}:7447", insecure=True, side="observer")


def test_zenoh_dials_no_ipv6_address_with_tls(keys: Keys, stack: contextlib.ExitStack) -> None:
    try:
        hub = Hub(security.hub_security(keys), ("tls/[::1]:0",))
    except zenoh.ZError:
        pytest.skip("this machine has no IPv6")
    stack.callback(hub.session.close)
    assert diagnosis.diagnose(hub.endpoint, bundle(keys, "car2")) is None
    with pytest.raises(zenoh.ZError):  # where this no longer holds, endpoint_rules need not refuse it
        dial(hub.endpoint, bundle(keys, "car2"))
    endpoint_rules(hub.endpoint, keys)
    for side in ("host", "observer"):
        with pytest.raises(UsageError, match="dials no IPv6 address with TLS: use a host name"):
            endpoint_rules(hub.endpoint, bundle(keys, "car2"), side=side)


@pytest.mark.parametrize(
    "endpoint",
    [
        "nonsense",
        "192.168.1.10:7447",
        "udp/127.0.0.1:7447",
        "tls/127.0.0.1",
        "tls/:7447",
        "tls/127.0.0.1:70000",
        "tls/10.0.0.1:7447#verify_name_on_connect=false",
        "tls/10.0.0.1:7447?rel=0",
        "tls/::1:7447",
        "tls/10.0.0.1:7447\n",
        "tls/a b:7447",
    ],
)
def test_endpoints_are_a_protocol_a_host_and_a_port(keys: Keys, endpoint: str) -> None:
    with pytest.raises(UsageError, match=r"must be tcp/HOST:PORT or tls/HOST:PORT, e\.g\."):
        endpoint_rules(endpoint, keys, insecure=True)


# --- another machine ---


@pytest.fixture
def other_machine() -> Iterator[str]:
    """A network namespace with address 10.213.7.1, linked to this one, which has 10.213.7.2."""
    space, near, far = (f"vc{os.getpid()}{end}" for end in "snf")
    if os.geteuid() != 0 or shutil.which("ip") is None:
        pytest.skip("network namespaces need root and the command ip")

    def ip(*arguments: str) -> None:
        subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)

    try:
        ip("netns", "add", space)
    except subprocess.CalledProcessError as error:
        pytest.skip(f"no network namespace can be made here: {error.stderr.strip()}")
    try:
        try:
            ip("link", "add", near, "type", "veth", "peer", "name", far, "netns", space)
        except subprocess.CalledProcessError as error:
            pytest.skip(f"no link between namespaces can be made here: {error.stderr.strip()}")
        ip("addr", "add", "10.213.7.2/30", "dev", near)
        ip("link", "set", near, "up")
        ip("-n", space, "addr", "add", "10.213.7.1/30", "dev", far)
        ip("-n", space, "link", "set", far, "up")
        yield space
    finally:
        subprocess.run(["ip", "link", "del", near], check=False, capture_output=True)
        subprocess.run(["ip", "netns", "del", space], check=False, capture_output=True)


def test_between_machines(other_machine: str, tmp_path: Path, foreign: Keys) -> None:
    there = ("ip", "netns", "exec", other_machine)
    endpoint = "tls/10.213.7.1:7447"
    held = authority.init(tmp_path / "keys")
    machine = authority.issue(held.folder, "car2", ["car2"])
    with hub_process(str(held.folder), endpoint, before=there):
        assert "not for '10.213.7.1'; on its machine: vcmvsp keys hub --name 10.213.7.1" in refused(endpoint, machine)
    authority.renew_hub(held.folder, ["10.213.7.1"])
    with hub_process(str(held.folder), endpoint, before=there):
        with dial(endpoint, machine) as host:
            assert greet(host, "car2") == [b"welcome"]
            assert greet(host, "car3") == []
        assert "another authority than" in refused(endpoint, bundle(foreign, "car2"))
        assert "wants certificates" in refused(endpoint.replace("tls/", "tcp/"), None)
