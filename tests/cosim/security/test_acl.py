"""Access rules of the network with real certificates and real sessions: rights of admitted machines to send and receive."""

import contextlib
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec
import pytest
import zenoh

from tests.support.cosim.secure_hub import (
    PATIENCE_S,
    TOPIC,
    Hub,
    answer_queries,
    bundle,
    dial,
    direct,
    greet,
    inquire,
    issue_certificates,
    replies_of,
    reply,
    settle,
    until,
)
from vcmvsp.cosim.security import certificates
from vcmvsp.cosim.security.certificates import Keys
from vcmvsp.cosim.transport import access_control, key_names

pytestmark = pytest.mark.sockets

ALL = frozenset({"greeted", "answered", "alive", "hub seen", "told", "topics", "page", "scenery", "anna told", "anna sees hub"})


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return issue_certificates(tmp_path_factory.mktemp("network"))


@pytest.fixture
def hub(keys: Keys, stack: contextlib.ExitStack) -> Hub:
    return stack.enter_context(Hub(access_control.hub_security(keys)))


class Stage:
    """A hub, the host of car2 and the observer anna, as in a run; all received messages are counted."""

    def __init__(self, keys: Keys, rules: dict[str, Any], stack: contextlib.ExitStack) -> None:
        self.counts: Counter[str] = Counter()
        self.hub = stack.enter_context(Hub(rules))
        self.host = stack.enter_context(dial(self.hub.endpoint, bundle(keys, "car2")))
        self.anna = stack.enter_context(dial(self.hub.endpoint, bundle(keys, "anna")))
        zid = str(self.host.zid())
        self.keys = key_names.host_key("car2", zid, "ask"), key_names.host_key("car2", zid, "alive")
        answer_queries(self.host, self.keys[0], self._on_question)
        self._token = self.host.liveliness().declare_token(self.keys[1])
        watch = direct(lambda sample: self.counts.update([f"car2 sees hub {sample.kind}"]))
        self.host.liveliness().declare_subscriber(key_names.HUB_ALIVE, watch, history=True)
        look = direct(lambda sample: self.counts.update([f"anna sees hub {sample.kind}"]))
        self.anna.liveliness().declare_subscriber(key_names.HUB_ALIVE, look, history=True)
        hear = direct(lambda sample: self.counts.update([f"anna hears {sample.payload.to_string()}"]))
        for key in (key_names.TOPICS, key_names.PAGE_UPDATE):
            self.anna.declare_subscriber(key, hear)

    def _on_question(self, question: bytes) -> bytes:
        self.counts.update([f"car2 asked {question.decode()}"])
        return b"answer"

    def everything(self, expected: frozenset[str] = ALL) -> set[str]:
        """Which functions of a run work; waits for the expected ones."""
        checks: dict[str, Callable[[], object]] = {
            "greeted": lambda: greet(self.host, "car2") == [b"welcome"],
            "answered": lambda: self.hub.ask("car2", self.host, within_s=0.2) == [b"answer"],
            "alive": lambda: self.hub.counts[f"token {self.keys[1]}"],
            "hub seen": lambda: self.counts[f"car2 sees hub {zenoh.SampleKind.PUT}"],
            "told": lambda: inquire(self.host, "car2") == [b"welcome"],
            "topics": lambda: self._receptions_of(TOPIC, "truth"),
            "page": lambda: self._receptions_of(key_names.PAGE_UPDATE, "update"),
            "scenery": lambda: replies_of(self.anna, key_names.PAGE_SCENERY, b"scene") == [b"welcome"],
            "anna told": lambda: inquire(self.anna, "anna") == [b"welcome"],
            "anna sees hub": lambda: self.counts[f"anna sees hub {zenoh.SampleKind.PUT}"],
        }
        for name in expected:
            until(checks[name])
        settle()
        return {name for name, check in checks.items() if name in expected or check()}

    def _receptions_of(self, key: str, text: str) -> int:
        self.hub.session.put(key, text.encode())
        return self.counts[f"anna hears {text}"]


def _grants() -> list[tuple[str, str]]:
    """Every message of every rule of a host and an observer."""
    rules = access_control.access({"car2": access_control.HOST, "anna": access_control.OBSERVER})["rules"]
    return [(rule["id"], message) for rule in rules for message in rule["messages"]]


@pytest.mark.parametrize(("rule", "message"), _grants())
def test_no_rule_allows_more_than_a_run_needs(keys: Keys, stack: contextlib.ExitStack, rule: str, message: str) -> None:
    rules = access_control.hub_security(keys)
    for each in rules["access_control"]["rules"]:
        if each["id"] == rule:
            each["messages"] = [other for other in each["messages"] if other != message] or ["delete"]
    needs = {
        "greeted": ("car2/greets", "car2/is answered"),
        "answered": ("car2/listens", "car2/is asked", "car2/is heard", "car2/answers"),
        "alive": ("car2/is alive",),
        "hub seen": ("car2/watches", "car2/sees"),
        "told": ("car2/inquires", "car2/is told"),
        "topics": ("anna/listens", "anna/hears"),
        "page": ("anna/opens a page", "anna/sees it"),
        "scenery": ("anna/asks for scenery", "anna/gets it"),
        "anna told": ("anna/inquires", "anna/is told"),
        "anna sees hub": ("anna/watches", "anna/sees"),
    }
    (lost,) = (function for function, rules_of in needs.items() if rule in rules_of)
    assert Stage(keys, rules, stack).everything(ALL - {lost}) == ALL - {lost}


def attack(stage: Stage, session: zenoh.Session, name: str) -> Counter[str]:
    """All attempts to receive from others, to send for them or to pose as the hub; returns the effects at the attacker."""
    effects: Counter[str] = Counter()
    zid = str(session.zid())

    def lie(query: zenoh.Query) -> None:
        effects.update(["asked"])
        reply(query, b"false")

    for key in (
        "vcmvsp/join/car2",
        key_names.JOIN,
        "vcmvsp/about/car2",
        key_names.ABOUT,
        "**",
        *(() if name == "anna" else (key_names.PAGE_SCENERY,)),
        stage.keys[0],
        "vcmvsp/host/*/*/ask",
        "vcmvsp/hub/*",
    ):
        effects.update(f"reply on {key}" for each in session.get(key, payload=b"evil", timeout=1.0) if each.ok)
    for key in ("vcmvsp/host/**", stage.keys[1]):
        found = [str(each.ok.key_expr) for each in session.liveliness().get(key, timeout=1.0) if each.ok]
        effects.update(f"token {each}" for each in found)
        see = direct(lambda sample: effects.update([f"token {sample.key_expr}"]))
        session.liveliness().declare_subscriber(key, see, history=True)
    tokens = [key_names.host_key("car2", zid, "alive"), key_names.HUB_ALIVE, "vcmvsp/hub/*", f"vcmvsp/host/*/{zid}/alive"]
    declared = [session.liveliness().declare_token(key) for key in tokens]
    answer = key_names.answer_key(stage.keys[0])
    for key in (stage.keys[0], "vcmvsp/host/car2/*/ask", "vcmvsp/host/**", "**", "vcmvsp/join/car2", "vcmvsp/about/**"):
        session.declare_queryable(key, direct(lie), complete=True)
    secrets = (stage.keys[0], answer, "vcmvsp/host/**", "vcmvsp/join/**")
    for key in secrets if name == "anna" else (TOPIC, "**", *secrets):
        session.declare_subscriber(key, direct(lambda sample: effects.update([f"hears {sample.payload.to_string()}"])))
    settle()
    own_keys = f"vcmvsp/host/{name}/{zid}/ask", key_names.join_key(name)
    for key in (
        TOPIC,
        key_names.TOPICS,
        key_names.PAGE_UPDATE,
        "vcmvsp/**",
        "**",
        *own_keys,
        *secrets,
        "vcmvsp/host/*/*/answer",
    ):
        session.put(key, b"evil")
    stage.hub.ask("car2", stage.host)
    stage.hub.session.put(TOPIC, b"truth")
    stage.hub.session.put(key_names.PAGE_UPDATE, b"update")
    settle()
    for token in declared:
        token.undeclare()  # type: ignore[no-untyped-call]
    settle()
    own = {"hears evil", *(f"token {token}" for token in tokens)}  # a session receives its own
    return Counter({effect: count for effect, count in effects.items() if effect not in own})


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
@pytest.mark.parametrize("name", ["car3", "anna", "gone"])
def test_no_machine_eavesdrops_or_poses_as_another_or_as_the_run(
    keys: Keys, stack: contextlib.ExitStack, name: str, mode: str
) -> None:
    stage = Stage(keys, access_control.hub_security(keys), stack)
    session = stack.enter_context(dial(stage.hub.endpoint, bundle(keys, name), mode))
    until(lambda: stage.hub.links(name))
    effects = attack(stage, session, name)
    assert stage.everything() == ALL
    assert effects == {}
    sees = {f"{machine} sees hub {zenoh.SampleKind.PUT}" for machine in ("car2", "anna")}
    assert set(stage.counts) == {"car2 asked question", *sees, "anna hears truth", "anna hears update"}
    greetings = {f"greeting {key}" for key in ("vcmvsp/join/car2 hello", "vcmvsp/about/car2 about", "vcmvsp/about/anna about")}
    greetings |= {f"greeting {key_names.PAGE_SCENERY} scene"}
    assert set(stage.hub.counts) == {*greetings, f"token {stage.keys[1]}", "sample truth", "sample update"}


def test_without_the_rules_all_attacks_succeed(keys: Keys, stack: contextlib.ExitStack) -> None:
    rules = access_control.hub_security(keys)
    del rules["access_control"]
    stage = Stage(keys, rules, stack)
    session = stack.enter_context(dial(stage.hub.endpoint, bundle(keys, "car3")))
    at_hub = "sample evil", "greeting vcmvsp/join/car2 evil", f"token {key_names.HUB_ALIVE}"

    def succeeds() -> bool:
        """Late or dropped messages are sent again."""
        effects = attack(stage, session, "car3")
        received = all(effects[f"hears {effect}"] for effect in ("question", "answer", "truth"))
        sent = stage.counts["car2 asked evil"] and stage.counts["anna hears evil"]
        return received and bool(sent) and all(stage.hub.counts[effect] for effect in at_hub)

    until(succeeds)


def test_a_revoked_machine_gets_no_answer_but_a_reason(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "gone")) as session:
        until(lambda: hub.links("gone"))  # now the run can name it
        assert greet(session, "gone") == []
        assert hub.counts == {}
    assert access_control.admission(keys, "gone", ["gone"]) == "the certificate of 'gone' has been revoked"
    assert "'gone' is unknown to this run: its certificate was revoked" in access_control.silence("gone")


def test_with_all_revoked_none_is_admitted(keys: Keys, stack: contextlib.ExitStack) -> None:
    nobody = msgspec.structs.replace(keys, index=certificates.Index())
    empty = stack.enter_context(Hub(access_control.hub_security(nobody)))
    with dial(empty.endpoint, bundle(keys, "car2")) as session:
        assert greet(session, "car2") == []
        session.put(TOPIC, b"evil")
        settle()
    assert empty.counts == {}


def test_admission_is_by_certified_vehicles(keys: Keys) -> None:
    assert access_control.admission(keys, "car2", ["car2"]) is None
    assert access_control.admission(keys, "car2", ["car2", "car3"]) == "the certificate of 'car2' is for car2, not for car3"
    assert access_control.admission(keys, "anna", ["car2"]) == "the certificate of 'anna' is for watching only"
    assert access_control.admission(keys, "stranger", ["car2"]) == "'stranger' has no certificate of this run"


def test_wildcard_keys_have_no_speaker(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        wide = "vcmvsp/host/car2/*/alive"
        token = host.liveliness().declare_token(wide)
        until(lambda: hub.counts[f"token {wide}"])  # Zenoh accepts it: it is within car2's rights
        assert key_names.speaker(wide) is None
        token.undeclare()  # type: ignore[no-untyped-call]


def test_messages_beyond_the_limits_are_dropped_and_the_link_stays(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        assert greet(host, "car2", b"x" * access_control.MAX_JOIN) == [b"welcome"]
        assert greet(host, "car2", b"x" * (access_control.MAX_JOIN + 1)) == []
        key = key_names.host_key("car2", str(host.zid()), "ask")
        answer_queries(host, key, lambda question: b"answer".ljust(int(question)))
        assert greet(host, "car2") == [b"welcome"]
        assert hub.ask("car2", host, b"%d" % (access_control.MAX_MESSAGE + 1)) == []
        half = access_control.MAX_MESSAGE // 2
        assert [len(each) for each in hub.ask("car2", host, b"%d" % half, PATIENCE_S)] == [half]
    assert hub.counts == {"greeting vcmvsp/join/car2 xxxxx": 1, "greeting vcmvsp/join/car2 hello": 1}


def test_the_hubs_admin_space_is_not_readable(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        zid = str(hub.session.zid())
        for key in ("@/**", f"@/{zid}/**", f"@/{zid}/router"):
            found = [str(each.ok.key_expr) for each in host.get(key, timeout=1.0) if each.ok]
            assert not [each for each in found if not each.startswith(f"@/{host.zid()}/")]
