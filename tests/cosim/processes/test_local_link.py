"""Links to own processes on this machine: whole messages or none."""

from collections.abc import Iterator
from contextlib import closing

import pytest

from vcmvsp.cosim.processes.child_process import LONGEST, LocalLink, pair

Ends = tuple[LocalLink, LocalLink]


@pytest.fixture
def ends() -> Iterator[Ends]:
    here, other_end = pair()
    with closing(here), closing(LocalLink(other_end)) as there:
        yield here, there


def test_messages_arrive_whole_and_in_order_until_the_end(ends: Ends) -> None:
    here, there = ends
    messages = [b"x", bytes(100_000), b"last"]
    for message in messages:
        assert here.send(message)
    assert there.receive() == messages
    assert not there.ended
    here.close()
    assert (there.receive(), there.ended, there.send(b"x")) == ([], True, False)


def test_an_idle_reader_blocks_no_sender(ends: Ends) -> None:
    here, there = ends
    sent = 0
    while here.send(b"%d" % sent):
        sent += 1
    assert there.receive() == [b"%d" % number for number in range(sent)]
    assert here.send(b"on")


def test_a_too_long_message_is_refused_and_the_link_stays(ends: Ends) -> None:
    here, there = ends
    with pytest.raises(ValueError, match="a message of 10000000 bytes is too long for the link"):
        here.send(bytes(10_000_000))
    assert here.send(b"short")
    assert there.receive() == [b"short"]


def test_a_truncated_message_is_an_error(ends: Ends, monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = ends
    monkeypatch.setattr("vcmvsp.cosim.processes.child_process.LONGEST", 1000)
    assert LONGEST > 1000
    assert here.send(bytes(1001))
    with pytest.raises(ValueError, match="a message was longer than 1000 bytes"):
        there.receive()
