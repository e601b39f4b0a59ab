"""Content that exceeds one message reaches the bridge's process complete and in order."""

from unittest import mock

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.types import Array, Traffic, frozen
from vcmvsp.cosim.util.codec import encode
from vcmvsp.netsim.bridge import messages

ROOM = 200_000  # largest message, bytes, that every Linux accepts (`cosim.processes.child_process`)


def traffic(deliveries: int, settled: int) -> tuple[Traffic, Array]:
    number = np.arange(deliveries)
    radio_traffic = Traffic(
        reports=(),
        carries=frozen(np.zeros(0, np.int64)),
        number=frozen(number),
        receiver=frozen(number % 7, np.int32),
        arrival_ns=frozen(number),
        frame=frozen(number),
        settled=frozen(10**9 + np.arange(settled)),
    )
    return radio_traffic, frozen(10**18 + number)


@given(deliveries=st.integers(0, 20), settled=st.integers(0, 20), most=st.integers(1, 8))
def test_deliveries_arrive_complete_and_before_acknowledgements(deliveries: int, settled: int, most: int) -> None:
    radio_traffic, at_ns = traffic(deliveries, settled)
    with mock.patch.object(messages, "MOST_DUE", most):
        chunks = list(messages.due_in_chunks(42, radio_traffic, at_ns))
    assert np.concatenate([each.number for each in chunks]).tolist() == radio_traffic.number.tolist()
    assert np.concatenate([each.receiver for each in chunks]).tolist() == radio_traffic.receiver.tolist()
    assert np.concatenate([each.at_ns for each in chunks]).tolist() == at_ns.tolist()
    assert np.concatenate([each.settled for each in chunks]).tolist() == radio_traffic.settled.tolist()
    assert {each.taken for each in chunks} == {42}
    assert max(len(each.number) for each in chunks) <= most >= max(len(each.settled) for each in chunks)
    last = max((k for k, each in enumerate(chunks) if len(each.number)), default=0)
    assert not any(len(each.settled) for each in chunks[:last])


@given(vehicles=st.integers(1, 60), most=st.integers(1, 100))
def test_levels_come_row_by_row(vehicles: int, most: int) -> None:
    dbm = np.arange(vehicles * vehicles, dtype=np.float64).reshape(vehicles, vehicles)
    with mock.patch.object(messages, "MOST_LEVELS", most):
        chunks = list(messages.levels_in_chunks(dbm))
    assert [each.first for each in chunks] == np.cumsum([0, *(len(each.dbm) for each in chunks[:-1])]).tolist()
    assert np.concatenate([each.dbm for each in chunks]).tolist() == dbm.tolist()
    assert all(each.dbm.size <= max(most, vehicles) for each in chunks)


def test_the_longest_messages_fit() -> None:
    deliveries = messages.due_in_chunks(2**62, *traffic(3 * messages.MOST_DUE, 3 * messages.MOST_DUE))
    for each in (*deliveries, *messages.levels_in_chunks(np.full((500, 500), -81.25))):
        assert len(encode(each)) < ROOM
