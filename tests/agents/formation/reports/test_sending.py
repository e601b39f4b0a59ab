"""Times of reports: at every tick, or when the followers' estimate would be wrong."""

import math
from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.agents.agent_loop import bodies, drive, info, observe, present, reception_of_body
from vcmvsp.agents.formation.followers.leader_follower import LeaderFollower
from vcmvsp.agents.formation.leaders.trajectory import Trajectory
from vcmvsp.agents.formation.reports.prediction import DeadReckoning, Estimator, Hold
from vcmvsp.agents.formation.reports.report import LeaderState, Report
from vcmvsp.agents.formation.reports.sending import REMEMBERED, Reporter, Sending, acknowledge
from vcmvsp.agents.formation.team.shape import Formation
from vcmvsp.cosim.agent import Radio
from vcmvsp.cosim.frames import arc

NAMES = ("leader", "f0", "f1")
NEEDED = Sending(when="needed")


class Sender:
    """A reporter, tick by tick at 10 Hz."""

    def __init__(self, sending: Sending, listeners: Sequence[str] = (), estimator: Estimator | None = None) -> None:
        self.reporter = Reporter(sending, estimator)
        if listeners:
            self.reporter.start(listeners)
        self.radio, self.tick = Radio("leader", NAMES), -1

    def __call__(self, state: LeaderState, *answers: tuple[str, Any]) -> dict[str, Any] | None:
        """The report of this tick, if any; ``answers``: followers and the numbers that they confirm."""
        self.tick += 1
        receptions = [reception_of_body(name, {"ack": number}) for name, number in answers]
        x, y, th, v, w = state
        self.reporter.tell(self.radio, observe((x, y, th), self.tick * 100_000_000, receptions), v, w)
        sent = bodies(self.radio)
        assert len(sent) <= 1
        return sent[0] if sent else None


STILL = LeaderState(0.0, 0.0, 0.0, 0.0, 0.0)


def jump(metres: float) -> LeaderState:
    return LeaderState(metres, 0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("estimator", [DeadReckoning(), Hold(), DeadReckoning(0.3, 0.2)])
@given(
    commands=st.lists(st.tuples(st.floats(-0.5, 1.0), st.floats(-1.0, 1.0)), min_size=1, max_size=60),
    threshold=st.floats(0.005, 0.2),
    silence_s=st.floats(0.3, 3.0),
)
def test_without_loss_the_error_never_exceeds_the_threshold(
    estimator: Estimator, commands: list[tuple[float, float]], threshold: float, silence_s: float
) -> None:
    """Reports are due to the threshold or to the silence, or the first; no other report is sent."""
    sending = Sending(when="needed", threshold=threshold, silence_s=silence_s, acknowledge=False)
    sender, pose, known = Sender(sending, estimator=estimator), (0.0, 0.0, 0.0), None
    for tick, (v, w) in enumerate(commands):
        wrong, since = math.inf, math.inf
        if known is not None:
            since = tick * 0.1 - known.t_ns / 1e9
            x, y, th, _, _ = estimator.predict(known, since)
            wrong = math.hypot(x - pose[0], y - pose[1]) + 0.5 * abs(th - pose[2])
        body = sender(LeaderState(*pose, v, w))
        if body is None:
            assert wrong <= threshold + 1e-9
            assert since < silence_s + 1e-9
        else:
            assert wrong > threshold - 1e-9 or since >= silence_s - 1e-9
            known = Report(body["t_ns"], LeaderState(*pose, v, w), body)
        pose = arc(pose, v, w, 0.1)


def test_predictable_motion_is_not_reported() -> None:
    """Constant speeds with dead reckoning, any path with a plan: one report per silence_s."""
    for path, estimator in (("circle", "dr"), ("random", "plan"), ("slalom", "plan")):
        leader = Trajectory(path, estimator=estimator, sending=NEEDED)  # type: ignore[arg-type]
        follower = LeaderFollower("leader", estimator=estimator)
        run = drive(leader, [follower], duration_s=40.0)
        assert np.flatnonzero(run.reports).tolist() == list(range(0, 401, 20)), path


def test_it_is_sent_again_until_it_is_confirmed() -> None:
    sender = Sender(NEEDED, ["f0"])
    first = present(sender(STILL))
    assert (first["seq"], first["ak"]) == (0, 1)
    assert sender(STILL) is None  # an answer may be under way
    assert present(sender(STILL))["seq"] == 1
    assert [sender(STILL, ("f0", 1))] + [sender(STILL) for _ in range(10)] == [None] * 11
    assert sender(jump(0.1)) is not None
    assert sender(jump(0.1)) is None
    assert sender(jump(0.1)) is not None  # number 2 was not confirmed: f0 still has number 1
    assert sender(jump(0.1), ("f0", 2)) is None  # late; its content equals number 3
    assert [sender(jump(0.1)) for _ in range(5)] == [None] * 5


def test_all_followers_must_confirm() -> None:
    sender = Sender(NEEDED, ["f0", "f1"])
    sender(STILL)
    assert sender(STILL, ("f0", 0)) is None
    assert sender(STILL) is not None
    assert sender(STILL, ("f1", 1)) is None  # f0 has number 0 with equal content
    assert [sender(STILL) for _ in range(10)] == [None] * 10


def test_a_receiver_that_answers_is_awaited_until_its_timeout() -> None:
    sender = Sender(NEEDED)
    assert sender(STILL) is not None
    assert [sender(jump(0.0)) for _ in range(4)] == [None] * 4  # no known followers
    sender(STILL, ("f1", 0))
    sent = [sender(jump(0.1 * (tick // 50))) is not None for tick in range(250)]  # a jump every 5 s, which f1 does not confirm
    repeated = [sent[start : start + 10].count(True) for start in range(50, 250, 50)]
    assert repeated[0] == 5  # every 0.2 s
    assert repeated[-1] == 1  # dropped 10 s after its only answer


def test_the_listeners_can_change() -> None:
    sender = Sender(NEEDED, ["f0"])
    sender(STILL, ("f0", 0))
    sender(STILL, ("f0", 0))
    sender.reporter.start(["f1"])  # answers of f0 no longer count; f1 has received nothing
    assert [sender(STILL) is not None for _ in range(5)].count(True) >= 2
    sender.reporter.start([])
    assert [sender(STILL) for _ in range(5)] == [None] * 5


def test_a_new_shape_is_reported_at_once_and_until_it_is_confirmed() -> None:
    """The leader of a column is at rest; after 0.5 s the shape changes to a line."""
    leader = Trajectory("straight", speed=0.0, sending=NEEDED, formation=Formation(shape="column", changes=((0.5, "line"),)))
    leader.start(info("leader", NAMES))
    radio, reports = Radio("leader", NAMES), []
    for tick in range(20):
        receptions = [reception_of_body(name, {"ack": 0}) for name in ("f0", "f1") if tick == 1]
        leader.act(observe((0.0, 0.0, 0.0), tick * 100_000_000, receptions), radio)
        reports += [(tick, body["sn"]) for body in bodies(radio) if "sn" in body]
    assert reports == [(tick, 1) for tick in range(5, 20, 2)]  # every 0.2 s


@given(
    answers=st.lists(
        st.one_of(st.none(), st.integers(-5, 10**20), st.floats(), st.text(max_size=3), st.booleans(), st.just([])), max_size=8
    )
)
def test_malformed_answers_are_ignored(answers: list[Any]) -> None:
    sender, other = Sender(NEEDED, ["f0"]), Sender(NEEDED, ["f0"])
    for tick in range(12):
        noise = [("f0", each) for each in answers if type(each) is not int or not 0 <= each <= tick]
        assert (sender(STILL, *noise) is None) == (other(STILL) is None)


def test_other_messages_are_no_answers() -> None:
    reporter, radio = Reporter(NEEDED), Radio("leader", NAMES)
    receptions = [reception_of_body("f0", body) for body in (b"ack", {}, {"seq": 0, "x": 1.0})]
    reporter.tell(radio, observe((0.0, 0.0, 0.0), 0, receptions), 0.0, 0.0)
    assert len(radio.drain()) == 1


def test_old_reports_are_dropped_except_the_confirmed_ones() -> None:
    sender = Sender(NEEDED, ["f0"])
    sender(STILL)
    sender(STILL, ("f0", 0))
    for tick in range(90):  # then f0 is dropped
        sender(jump(0.1 * tick))
    assert sender.reporter._seq > REMEMBERED + 2
    assert 0 in sender.reporter._sent
    for tick in range(90, 1000):
        sender(jump(0.1 * tick))
    assert len(sender.reporter._sent) <= REMEMBERED + 2


@pytest.mark.parametrize(
    ("body", "answered"),
    [
        ({"seq": 7, "ak": 1}, True),
        ({"seq": 7}, False),
        ({"seq": 7, "ak": 0}, False),
        ({"ak": 1}, False),
        ({"seq": "7", "ak": 1}, False),
    ],
)
def test_a_follower_answers_on_request(body: dict[str, Any], answered: bool) -> None:
    radio = Radio("f0", NAMES)
    acknowledge(radio, Report(0, STILL, body), "leader")
    answers = radio.drain()
    assert len(answers) == answered
    for answer in answers:
        assert (answer.body, answer.to, answer.size_bytes) == ({"ack": 7}, "leader", len(msgspec.msgpack.encode({"ack": 7})))
