"""Host client: joining, answering, leaving; any answer may be lost and must then be repeated."""

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

from tests.support.cosim.run_processes import Forwarder
from tests.support.cosim.secure_hub import PATIENCE_S, lasting_links, until
from vcmvsp.cosim.errors import FederateError
from vcmvsp.cosim.hosts import host_client, protocol
from vcmvsp.cosim.hosts.hub import Hub

pytestmark = pytest.mark.sockets


class Desk:
    """Answers questions; ``at_end`` is called before the last answer."""

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
        """Nothing to close."""


class Question:
    """A question as received."""

    def __init__(self, number: int, oldest: int, content: bytes = b"") -> None:
        self.payload = self
        self._data = protocol.numbers.pack(number, oldest) + content

    def to_bytes(self) -> bytes:
        return self._data


def host_answers(
    *questions: Question | bool,
    patience_s: float = PATIENCE_S,
    hubs: str = "a",
    desk: Desk | None = None,
    answers: list[bytes] | None = None,
) -> tuple[list[bytes], list[Any]]:
    """Answers of a host, and questions that it has not read when it leaves; ``hubs``: identity of its hub at each look."""
    answers, inbox = [] if answers is None else answers, queue.SimpleQueue[Any]()
    for each in questions:
        inbox.put(each)
    found = itertools.chain(hubs, itertools.repeat(hubs[-1]))
    session = types.SimpleNamespace(info=types.SimpleNamespace(routers_zid=lambda: [next(found)]))
    says = types.SimpleNamespace(put=answers.append)
    host_client._answer(inbox, desk or Desk(), says, session, protocol.Welcome(None, patience_s), lambda _: None)  # type: ignore[arg-type]
    return answers, [inbox.get() for _ in range(inbox.qsize())]


END, FAREWELL = Question(1, 1, b"end"), Question(protocol.FAREWELL, 2)
UNREAD = Question(2, 2, b"more")


@pytest.mark.parametrize(
    ("questions", "count", "more"),
    [
        pytest.param([END, END, END, FAREWELL, UNREAD], 3, {}, id="repeated until the farewell"),
        pytest.param([FAREWELL, END, FAREWELL, UNREAD], 1, {}, id="a farewell before the end is ignored"),
        pytest.param([END], 1, {"patience_s": 0.01}, id="without further messages it leaves"),
        pytest.param([END, False, True], 1, {"patience_s": 0.01, "hubs": "ab"}, id="another run at its address is no error"),
    ],
)
def test_the_last_answer_of_a_host(questions: list[Question | bool], count: int, more: dict[str, Any]) -> None:
    answers, left = host_answers(*questions, **more)
    assert answers == [protocol.number.pack(1) + b"to end"] * count
    assert left == [each for each in questions if each is UNREAD]


def test_a_last_answer_lost_with_the_link_is_repeated_after_it(
    monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    lasting_links(monkeypatch)
    hub = Hub(patience_s=PATIENCE_S)
    stack.callback(hub.close)
    between = Forwarder(int(hub.endpoint.rpartition(":")[2]))
    stack.callback(between.close)
    cutting = threading.Thread(target=between.reset, args=(0.5,))

    def cut() -> None:
        cutting.start()
        until(lambda: hub.gone)
        time.sleep(0.1)  # until the host's own side detects it

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


def test_a_host_waits_for_a_run_that_does_not_answer_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run's machine may be busy for a second or two at that time."""
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
def test_each_question_is_processed_once_and_in_order_despite_repeats(
    script: list[tuple[int, int]],
) -> None:
    """A question that arrives too early gets no answer, and the run repeats it; a repeated question gets the same answer."""
    desk, answers = Desk(), list[bytes]()
    numbers = [(number, max(1, number - back)) for number, back in script]
    questions = [Question(number, oldest, b"%d" % number) for number, oldest in numbers]
    with pytest.raises(FederateError, match="is gone"):
        host_answers(*questions, False, patience_s=0.001, desk=desk, answers=answers)
    worked = desk.worked
    assert worked == [b"%d" % number for number in range(1, len(worked) + 1)]
    expected, last_number, stored_numbers = list[bytes](), 0, set[int]()
    for number, oldest in numbers:
        stored_numbers = {each for each in stored_numbers if each >= oldest}
        if number == last_number + 1:
            last_number = number
            stored_numbers.add(number)
        if number in stored_numbers:
            expected.append(protocol.number.pack(number) + b"to %d" % number)
    assert answers == expected
