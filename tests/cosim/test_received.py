"""Mailboxes deliver the messages that have arrived by a tick, in order of arrival; columns and items agree."""

from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from vcmvsp.cosim.received import Mailboxes, ReceivedMessages, pruned
from vcmvsp.cosim.types import Message, Reception, Receptions, frozen

NAMES = ("a", "b", "c", "d")


def message(number: int) -> Message:
    return Message(sender=NAMES[number % 4], body={"number": number}, size_bytes=9)


def random_batch(rng: np.random.Generator, first: int, sent_ns: int, longest_ns: int) -> Receptions:
    """Some messages of one instant with their receptions, in frame order."""
    count = int(rng.integers(1, 5))
    rows = np.sort(rng.integers(count, size=int(rng.integers(0, 9))))
    return Receptions(
        names=NAMES,
        messages=tuple(message(first + number) for number in range(count)),
        sent_ns=np.full(count, sent_ns),
        message=rows.astype(np.int32),
        receiver=rng.integers(4, size=len(rows)).astype(np.int32),
        arrival_ns=sent_ns + rng.integers(1, longest_ns, size=len(rows)),
        rssi_dbm=rng.uniform(-90.0, -40.0, len(rows)),
    )


def one_by_one(batch: Receptions) -> list[tuple[str, Reception]]:
    columns = (batch.message, batch.receiver, batch.arrival_ns, batch.rssi_dbm)
    items = []
    for number, receiver, arrival_ns, rssi_dbm in zip(*(each.tolist() for each in columns), strict=True):
        sent, sent_ns = batch.messages[number], int(batch.sent_ns[number])
        items.append((NAMES[receiver], Reception(message=sent, rssi_dbm=rssi_dbm, sent_ns=sent_ns, received_ns=arrival_ns)))
    return items


@pytest.mark.parametrize("longest_ns", [2, 5, 40])
@pytest.mark.parametrize("owners", [NAMES, ("b", "d")])
def test_each_message_is_delivered_once_at_the_first_tick_after_arrival_in_order(
    owners: Sequence[str], longest_ns: int
) -> None:
    rng = np.random.default_rng(longest_ns)
    mail, waiting, handed = Mailboxes(NAMES, owners), list[tuple[str, Reception]](), 0
    for now_ns in range(0, 3000, 5):
        for sent_ns in range(now_ns, now_ns + 5, 2):
            batch = random_batch(rng, now_ns, sent_ns, longest_ns)
            mail.put(batch)
            waiting += [each for each in one_by_one(batch) if each[0] in owners]
        due = [name for name in owners if rng.random() < 0.7]
        arrived = [each for each in waiting if each[0] in due and each[1].received_ns <= now_ns]
        waiting = [each for each in waiting if each not in arrived]
        by_arrival = sorted(arrived, key=lambda each: each[1].received_ns)  # stable
        expected = {name: [each for owner, each in by_arrival if owner == name] for name in due}
        got = mail.open(now_ns, due)
        assert {name: list(each) for name, each in got.items()} == {name: own for name, own in expected.items() if own}
        handed += len(arrived)
    assert handed > 1000


def test_mailboxes_keep_no_message_without_a_waiting_receiver() -> None:
    mail = Mailboxes(NAMES, NAMES)
    for now_ns in range(0, 1000, 10):  # each message arrives 25 ns after it was sent, so that some are always waiting
        batch = random_batch(np.random.default_rng(now_ns), now_ns, now_ns, 2)
        mail.put(msgspec.structs.replace(batch, arrival_ns=np.full(len(batch.receiver), now_ns + 25)))
        mail.open(now_ns)
        assert sum(len(each.messages) for _, each in mail._waiting) <= 4 * 4


def received() -> ReceivedMessages:
    batch = Receptions(
        names=NAMES,
        messages=tuple(map(message, range(6))),
        sent_ns=frozen([10, 20, 30, 30, 25, 30], np.int64),
        message=frozen([5, 0, 4, 1, 3, 2], np.int32),
        receiver=frozen([1] * 6, np.int32),
        arrival_ns=frozen([41, 42, 43, 44, 45, 46], np.int64),
        rssi_dbm=frozen(range(-60, -54), np.float64),
    )
    mail = Mailboxes(NAMES, NAMES)
    mail.put(batch)
    return mail.open(50)["b"]


def test_columns_equal_the_items() -> None:
    messages = received()
    assert messages.senders == tuple(each.message.sender for each in messages) == ("b", "a", "a", "b", "d", "c")
    assert messages.rssi_dbm.tolist() == [each.rssi_dbm for each in messages]
    assert messages.sent_ns.tolist() == [each.sent_ns for each in messages]
    assert messages.received_ns.tolist() == [each.received_ns for each in messages]
    assert messages.age_s.tolist() == [(50 - each.sent_ns) / 1e9 for each in messages]


def test_the_latest_of_a_sender_was_sent_last() -> None:
    numbers = {sender: each.message.body["number"] for sender, each in received().latest_by_sender().items()}  # type: ignore[call-overload]
    assert numbers == {"b": 5, "a": 4, "d": 3, "c": 2}


def test_every_access_to_an_item_gives_one_object() -> None:
    messages = received()
    last = messages[-1]
    assert messages[5] is last is list(messages)[5] is messages[3:][2] is messages.latest_by_sender()["c"]
    with pytest.raises(IndexError):
        messages[6]


def test_a_sequence_of_given_items_has_the_same_columns() -> None:
    messages = received()
    again = ReceivedMessages.of(list(messages), 50)
    assert again == messages
    assert (again.senders, again.age_s.tolist()) == (messages.senders, messages.age_s.tolist())
    assert not ReceivedMessages.none(0)


def test_a_pruned_batch_has_the_same_receptions() -> None:
    batch = random_batch(np.random.default_rng(3), 0, 5, 9)
    some = pruned(batch)
    assert one_by_one(some) == one_by_one(batch)
    assert set(map(id, some.messages)) == {id(batch.messages[number]) for number in batch.message.tolist()}
