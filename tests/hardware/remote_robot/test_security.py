"""Access to the robot of a vehicle: real certificates and sessions, and attempts by other machines."""

import contextlib
import queue
import time
from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from tests.support.cosim.run_processes import reserve_port
from tests.support.cosim.secure_hub import bundle, dial, direct, issue_certificates, replies_of
from tests.support.hardware.driver_runs import eventually
from vcmvsp.cosim.security import authority, certificates
from vcmvsp.cosim.transport import access_control, key_names
from vcmvsp.cosim.types import Odometry
from vcmvsp.cosim.util.codec import encode
from vcmvsp.hardware.drivers.base import Notice, Sample
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import RobotHello, RobotStatus, RobotWelcome
from vcmvsp.hardware.remote_robot.run_side.driver import Admission
from vcmvsp.hardware.remote_robot.run_side.listener import LinkEnded, News, Peer, RobotGreeting, RobotListener, RobotMessage

pytestmark = pytest.mark.sockets

ALL_GO = zenoh.CongestionControl.BLOCK  # otherwise Zenoh drops messages of a burst if its queue is full


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> certificates.Keys:
    folder = issue_certificates(tmp_path_factory.mktemp("doors")).folder
    authority.issue(folder, "laptop", ["car3", "car4"])
    return certificates.load(folder)


class ListenerHarness:
    """A listener for the robot of car3, and machines that connect to it."""

    def __init__(self, keys: certificates.Keys, stack: contextlib.ExitStack) -> None:
        self._keys, self._stack = keys, stack
        self.news: queue.SimpleQueue[News] = queue.SimpleQueue()
        self.endpoint = f"tls/127.0.0.1:{stack.enter_context(reserve_port())}"
        self.door = stack.enter_context(contextlib.closing(RobotListener(self.endpoint, keys, "car3", self._take)))

    def _take(self, news: News) -> None:
        if isinstance(news, RobotGreeting):
            news.answer(RobotWelcome(run="yes"))
        self.news.put(news)

    def all(self) -> list[News]:
        return [self.news.get() for _ in range(self.news.qsize())]

    def heard(self, act: Callable[[], object] = lambda: None) -> list[News]:
        """All news, once a message of a robot is among them; ``act`` is repeated meanwhile."""
        box: list[News] = []

        def came() -> bool:
            act()
            box.extend(self.all())
            return any(isinstance(each, RobotMessage) for each in box)

        eventually(came)
        return box

    def say_until(self, condition: Callable[[], object]) -> None:
        """Send to the followed robot until a condition holds."""

        def said() -> object:
            self.door.say(b"there")
            return condition()

        eventually(said)

    def dial(self, name: str) -> zenoh.Session:
        return self._stack.enter_context(dial(self.endpoint, bundle(self._keys, name)))


def is_welcome(session: zenoh.Session, name: str) -> bool:
    replies = replies_of(session, key_names.greet_key(name), b"hello")
    return any(messages.welcomes.decode(each).run == "yes" for each in replies)


def received_texts(session: zenoh.Session, key: str) -> list[str]:
    got: list[str] = []
    session.declare_subscriber(key, direct(lambda sample: got.append(sample.payload.to_string())))
    return got


def key_of(session: zenoh.Session, name: str, vehicle: str = "car3", what: Any = "up", zid: str = "") -> str:
    return key_names.robot_key(name, vehicle, zid or str(session.zid()), what)


@pytest.mark.parametrize("name", ["car3", "laptop"])
def test_a_certificate_for_the_vehicle_permits_both_ways(
    keys: certificates.Keys, stack: contextlib.ExitStack, name: str
) -> None:
    stage = ListenerHarness(keys, stack)
    robot = stage.dial(name)
    assert is_welcome(robot, name)
    peer = Peer(name, str(robot.zid()))
    stage.door.follow(peer)
    texts = received_texts(robot, key_of(robot, name, what="down"))
    token = robot.liveliness().declare_token(key_of(robot, name, what="alive"))
    stage.say_until(lambda: texts)
    box = stage.heard(lambda: robot.put(key_of(robot, name), b"here"))
    assert {each.peer for each in box if isinstance(each, RobotMessage)} == {peer}
    token.undeclare()  # type: ignore[no-untyped-call]
    eventually(lambda: LinkEnded(peer) in stage.all())


def test_others_cannot_send_receive_or_replace_it(keys: certificates.Keys, stack: contextlib.ExitStack) -> None:
    stage = ListenerHarness(keys, stack)
    robot = stage.dial("car3")
    assert is_welcome(robot, "car3")
    peer = Peer("car3", str(robot.zid()))
    stage.door.follow(peer)
    texts = received_texts(robot, key_of(robot, "car3", what="down"))
    stage.say_until(lambda: texts)
    others = {name: stage.dial(name) for name in ("car2", "anna", "gone")}
    texts_by_session = {}
    for name, session in others.items():
        assert is_welcome(session, name) == (name == "car2")  # for the reason of the refusal
        assert not is_welcome(session, "car3")
        texts_by_session[name] = received_texts(session, "vcmvsp/robot/**")
        for key in (key_of(session, "car3", zid=peer.session), key_of(session, name, zid=peer.session), key_of(session, name)):
            session.put(key, b"lie", congestion_control=ALL_GO)
        for key in (
            "vcmvsp/robot/*/car3/*/up",
            "vcmvsp/robot/**",
            key_of(session, "car3", what="down", zid=peer.session),
            "**",
        ):
            session.put(key, b"lie", congestion_control=ALL_GO)
        tokens = [session.liveliness().declare_token(key_of(session, "car3", what="alive", zid=peer.session))]
        tokens.append(session.liveliness().declare_token(key_names.HUB_ALIVE))
        for token in tokens:
            token.undeclare()  # type: ignore[no-untyped-call]
    stage.door.say(b"there")
    for key, data in (
        ("vcmvsp/robot/car3/car3/*/up", b"for many"),  # permitted, but with a wildcard
        (key_of(robot, "car3"), b"x" * (access_control.MAX_ROBOT + 1)),
        (key_of(robot, "car3"), b"truth"),
    ):
        robot.put(key, data, congestion_control=ALL_GO)
    box = stage.heard()
    time.sleep(0.1)  # for messages that should not arrive
    box += stage.all()
    assert [each.data for each in box if isinstance(each, RobotMessage)] == [b"truth"]
    assert not [each for each in box if isinstance(each, LinkEnded)]
    assert {each.name for each in box if isinstance(each, RobotGreeting)} == {"car3", "car2"}
    assert {word for got in texts_by_session.values() for word in got} == {"lie"}  # a session receives its own messages


def test_without_the_rules_others_get_through(
    keys: certificates.Keys, stack: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    rules = access_control.driver_security(keys, "car3")
    del rules["access_control"]
    monkeypatch.setattr(access_control, "driver_security", lambda *_: rules)
    stage = ListenerHarness(keys, stack)
    peer = Peer("car3", "a1")
    stage.door.follow(peer)
    other = stage.dial("car2")
    texts = received_texts(other, key_of(other, "car3", what="down", zid="a1"))
    stage.say_until(lambda: "there" in texts)
    stage.heard(lambda: other.put(key_of(other, "car3", zid="a1"), b"lie"))


def test_keys_name_the_sender_and_names_cannot_forge_keys() -> None:
    key = key_names.robot_key("laptop", "car3", "a1", "up")
    assert key == "vcmvsp/robot/laptop/car3/a1/up"
    assert key_names.robot_speaker(key) == ("laptop", "car3", "a1")
    assert key_names.robot_speaker(key_names.greet_key("laptop")) == ("laptop", "", "")
    for wrong in ("vcmvsp/robot/*/car3/a1/up", "vcmvsp/robot/laptop/car3/*/up", "vcmvsp/robot/laptop/car3/a1/up/x", f"{key}\n"):
        assert key_names.robot_speaker(wrong) is None
    for name, vehicle, zid in (
        ("a/b", "car3", "a1"),
        ("a", "car*", "a1"),
        ("a", "car3", "**"),
        ("a", "car3", ""),
        ("", "c", "a"),
    ):
        with pytest.raises(ValueError, match="no key of a robot"):
            key_names.robot_key(name, vehicle, zid, "up")


def test_the_longest_status_fits_into_a_message() -> None:
    many = tuple(Notice(time_ns=2**62, what="stopped", cause="\U0001f916" * 500) for _ in range(messages.NOTICES_AT_ONCE))
    odometry = Odometry(pose=(1.0, 1.0, 1.0), v=1.0, w=1.0)
    sample = Sample(number=1, link=1, arrived_ns=1, measured_ns=1, odometry=odometry, sonar=((1, 1.0),) * 64)
    assert len(encode(RobotStatus(said_ns=2**62, sample=sample, notices=many))) < access_control.MAX_ROBOT


def test_refusals_have_a_reason(keys: certificates.Keys) -> None:
    def refusal(name: str, vehicle: str = "car3", protocol: int = messages.PROTOCOL) -> str:
        hello = RobotHello(protocol=protocol, vehicle=vehicle, robot="r", session="a1", device="bench")
        return Admission("car3", keys.folder).refusal(name, hello)

    assert refusal("car3") == refusal("laptop") == ""
    assert refusal("car2") == "the certificate of 'car2' is for car2, not for car3"
    assert (
        refusal("car2", "car2") == refusal("laptop", "car4").replace("car4", "car2") == "this port belongs to car3, not to car2"
    )
    assert refusal("gone") == "the certificate of 'gone' has been revoked"
    assert refusal("anna") == "the certificate of 'anna' is for watching only"
    assert refusal("car3", protocol=99).endswith("use the same vcmvsp version")
    assert "\x1b" not in refusal("car3", "\x1b[2Jcar")
    anybody = Admission("car3", None)
    assert (
        anybody.refusal(key_names.OPEN, RobotHello(protocol=1, vehicle="car3", robot="r", session="a1", device="bench")) == ""
    )
