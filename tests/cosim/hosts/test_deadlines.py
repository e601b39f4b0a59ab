"""Deadlines of answers: time in which the run itself stands still, such as a suspended virtual machine, does not count."""

import queue
from unittest.mock import Mock

import pytest

from vcmvsp.cosim.hosts import hub, protocol
from vcmvsp.cosim.hosts.hub import ZenohLink
from vcmvsp.cosim.hosts.remote_host import LateError

DEADLINE_S = 2.0


class Answers:
    """A queue whose waits end ``stalled_s`` too late; after ``waits`` of them it has an answer. It is its own clock."""

    def __init__(self, link: ZenohLink, stalled_s: float, waits: int) -> None:
        self.now_s, self._stalled_s, self._waits = 0.0, stalled_s, waits
        self._sample = Mock(key_expr=link._answers)
        self._sample.payload.to_bytes.return_value = protocol.number.pack(1) + b"answer"

    def get(self, timeout: float) -> Mock:
        """Wait, and get the answer if there is one."""
        if not self._waits:
            return self._sample
        self._waits -= 1
        self.now_s += timeout + self._stalled_s
        raise queue.Empty

    def qsize(self) -> int:
        """Nothing waits after a deadline."""
        return 0


@pytest.mark.parametrize(
    ("stalled_s", "waits", "is_late"), [(0.0, 1, False), (30.0, 1, False), (0.0, 5, True), (30.0, 5, True)]
)
def test_a_deadline_leaves_out_the_time_in_which_the_run_stood_still(
    stalled_s: float, waits: int, is_late: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each wait takes a second at most, and in addition the time for which the process stood still."""
    link = ZenohLink(Mock(), "host", seal=b"")
    answers = Answers(link, stalled_s, waits)
    monkeypatch.setattr(link, "_news", answers)
    monkeypatch.setattr(hub, "time", Mock(monotonic=lambda: answers.now_s))
    link.ask(b"question", DEADLINE_S)
    if is_late:
        with pytest.raises(LateError, match="deadline of 2 s"):
            link.answer()
        assert answers.now_s == pytest.approx(DEADLINE_S + 2 * stalled_s)
    else:
        assert link.answer() == b"answer"
