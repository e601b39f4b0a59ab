"""A host as it joins a run, answers its questions, and leaves: any answer may be lost, and must be given again then."""

import contextlib
import itertools
import queue
import threading
import time
import types
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.cosim.run_processes import Wire
from tests.support.cosim.secure_hub import PATIENCE_S, lasting_links, until
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.hosts import host_client, protocol
from vcmvsp.cosim.hosts.hub import Hub

pytestmark = pytest.mark.sockets


class Desk:
    """Answers; ``at_end`` is called before it does so for the last time."""

    failure = None

    def __init__(self, at_end: Callable[[], None] = lambda: None) -> None:
        self.ended: str | None = None
        self.worked: list[bytes] = []
        self._at_end = at_end

    def handle(self, question: memoryview) -> bytes:
        self.worked.append(bytes(question))
        if bytes(question) == b"end":
            self.ended = "the run is over"
            self._at_end()
        return b"to " + bytes(question)

    def close(self) -> None:
        """Nothing."""


class Asked:
    """A question as it comes in."""

    def __init__(self, number: int, oldest: int, content: bytes = b"") -> None:
        self.payload = self
        self._data = protocol.numbers.pack(number, oldest) + content

    def to_bytes(self) -> bytes:
        return self._data


def answered(
    *asked: Asked | bool,
    patience_s: float = PATIENCE_S,
    hubs: str = "a",
    desk: Desk | None = None,
    said: list[bytes] | None = None,
) -> tuple[list[bytes], list[Any]]:
    """What a host says to this, and what it has not read when it leaves; ``hubs``: those that it finds, look by look."""
    said, inbox = [] if said is None else said, queue.SimpleQueue[Any]()
    for each in asked:
        inbox.put(each)
    found = itertools.chain(hubs, itertools.repeat(hubs[-1]))
    session = types.SimpleNamespace(info=types.SimpleNamespace(routers_zid=lambda: [next(found)]))
    says = types.SimpleNamespace(put=said.append)
    host_client._answer(inbox, desk or Desk(), says, session, protocol.Welcome(None, patience_s), lambda _: None)  # type: ignore[arg-type]
    return said, [inbox.get() for _ in range(inbox.qsize())]


def test_the_last_answer_is_given_again_until_the_run_waits_for_none_any_more() -> None:
    end, unread = Asked(2, 2, b"end"), Asked(3, 3, b"more")
    said, left = answered(Asked(1, 1, b"act"), end, end, end, Asked(protocol.FAREWELL, 3), unread)
    assert said == [protocol.number.pack(1) + b"to act", *[protocol.number.pack(2) + b"to end"] * 3]
    assert left == [unread]


def test_a_farewell_to_who_has_not_been_told_of_the_end_says_nothing() -> None:
    said, left = answered(Asked(protocol.FAREWELL, 2), Asked(1, 1, b"end"), Asked(protocol.FAREWELL, 2))
    assert (said, left) == ([protocol.number.pack(1) + b"to end"], [])


def test_who_hears_no_more_of_its_run_leaves() -> None:
    assert answered(Asked(1, 1, b"end"), patience_s=0.01) == ([protocol.number.pack(1) + b"to end"], [])


def test_who_has_answered_to_the_end_of_a_run_does_not_mind_that_another_one_listens_there_now() -> None:
    said, left = answered(Asked(1, 1, b"end"), False, True, patience_s=0.01, hubs="ab")
    assert (said, left) == ([protocol.number.pack(1) + b"to end"], [])


def test_an_answer_that_is_lost_with_the_link_at_the_end_comes_when_the_link_is_back(
    monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    lasting_links(monkeypatch)
    hub = Hub(patience_s=PATIENCE_S)
    stack.callback(hub.close)
    between = Wire(int(hub.endpoint.rpartition(":")[2]))
    stack.callback(between.close)
    cutting = threading.Thread(target=between.reset, args=(0.5,))

    def cut() -> None:
        cutting.start()
        until(lambda: hub.gone)
        time.sleep(0.1)  # for the host's own side to notice

    def host() -> None:
        def hello(own: str) -> protocol.Hello:
            return protocol.Hello(own, protocol.PROTOCOL, ("car2",))

        ends.append(host_client.serve(hello, Desk(cut), f"tcp/127.0.0.1:{between.port}", secret=""))  # type: ignore[arg-type]

    ends = list[str]()
    hosting = threading.Thread(target=host)
    hosting.start()
    knock = hub.next_hello(PATIENCE_S)
    assert knock is not None
    link = knock.answer(None)
    assert link is not None
    for question in (b"act", b"end"):
        link.ask(question, PATIENCE_S)
        assert link.answer() == b"to " + question
    assert len(link.cuts_s) == 1
    link.close()
    hosting.join(PATIENCE_S)
    cutting.join()
    assert ends == ["the run is over"]


def test_a_run_that_listens_but_has_not_opened_its_door_yet_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its machine may be held up for a second or two just then."""
    now_s = [0.0]

    def sleep(seconds: float) -> None:
        now_s[0] += seconds

    def get(*_: object, **__: object) -> list[Any]:
        content = protocol.encode(protocol.Welcome(refused=None, patience_s=7.0))
        payload = types.SimpleNamespace(to_bytes=lambda: content)
        return [types.SimpleNamespace(ok=types.SimpleNamespace(payload=payload))] if now_s[0] > 2.0 else []

    monkeypatch.setattr(host_client, "time", types.SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep))
    hello = protocol.Hello("1" * 32, protocol.PROTOCOL, ("car2",))
    session: Any = types.SimpleNamespace(get=get)
    assert host_client._join(session, "anyone", hello).patience_s == 7.0


@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 3)), max_size=60))
def test_whatever_is_asked_again_and_in_whatever_order_each_question_is_worked_on_once_and_in_turn(
    script: list[tuple[int, int]],
) -> None:
    """One that is asked too early gets no answer, upon which the run asks again; one that is asked again, the same answer."""
    desk, said = Desk(), list[bytes]()
    asked = [(number, max(1, number - back)) for number, back in script]
    questions = [Asked(number, oldest, b"%d" % number) for number, oldest in asked]
    with pytest.raises(FederateError, match="is gone"):
        answered(*questions, False, patience_s=0.001, desk=desk, said=said)
    worked = desk.worked
    assert worked == [b"%d" % number for number in range(1, len(worked) + 1)]
    expected, done, kept = list[bytes](), 0, set[int]()
    for number, oldest in asked:
        kept = {each for each in kept if each >= oldest}
        if number == done + 1:
            done = number
            kept.add(number)
        if number in kept:
            expected.append(protocol.number.pack(number) + b"to %d" % number)
    assert said == expected
