from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.netsim.bridge import datagram_store
from vcmvsp.netsim.bridge.datagram_store import BATCH, BATCH_BYTES, BATCH_OF_ONE, MOST, MOST_BYTES, DatagramStore
from vcmvsp.netsim.bridge.gateways.base import BROADCAST


def put(store: DatagramStore, sender: int = 0, size: int = 10, to: int = BROADCAST, came_ns: int = 0) -> bool:
    return store.put(None, sender, to, bytes(size), came_ns)


def finish(store: DatagramStore, numbers: list[int]) -> None:
    for number in numbers:
        store.settle(number)


def test_each_vehicle_has_room_for_its_own_number_of_datagrams() -> None:
    store = DatagramStore(2)
    assert sum(put(store) for _ in range(MOST + 10)) == MOST
    assert put(store, sender=1)
    finish(store, store.batch()[:1])
    assert put(store)
    assert not put(store)


def test_each_vehicle_has_room_for_its_own_number_of_bytes() -> None:
    store = DatagramStore(1)
    most = MOST_BYTES // 65_535
    assert sum(put(store, size=65_535) for _ in range(most + 10)) == most
    assert put(store, size=10)


def test_unacknowledged_and_undelivered_datagrams_count_as_held() -> None:
    store = DatagramStore(1)
    for _ in range(MOST):
        put(store)
    (first, second, *_) = store.batch()
    store.due(first)
    store.settle(first)
    assert not put(store)
    store.mark_delivered(first)
    assert put(store)
    store.due(second)
    store.mark_delivered(second)
    assert not put(store)
    store.settle(second)
    assert put(store)


def test_batches_are_shared_fairly_among_vehicles() -> None:
    store = DatagramStore(20)
    for sender in range(20):
        for _ in range(2 if sender == 7 else 300):
            put(store, sender)
    all_senders: set[int] = set()
    for _ in range(-(-20 * BATCH_OF_ONE // BATCH)):  # missing in one batch, present in the next
        numbers = store.batch()
        assert len(numbers) <= BATCH
        senders = [store[number].sender for number in numbers]
        assert max(senders.count(each) for each in set(senders)) <= BATCH_OF_ONE
        all_senders |= set(senders)
    assert all_senders == set(range(20))


def test_where_bytes_go_along_a_batch_is_short_unless_one_datagram_is_long() -> None:
    store = DatagramStore(3, payloads=True)
    for sender in (0, 1, 2):
        for _ in range(300):
            put(store, sender, size=1472)
    all_senders: set[int] = set()
    for _ in range(3):
        numbers = store.batch()
        assert 1 < len(numbers) <= BATCH_BYTES // 1472
        all_senders |= {store[number].sender for number in numbers}
    assert all_senders == {0, 1, 2}
    store = DatagramStore(1, payloads=True)
    put(store, size=65_535)
    put(store, size=65_535)
    assert len(store.batch()) == 1
    assert len(store.batch()) == 1


def test_a_lost_unicast_datagram_is_reported() -> None:
    store = DatagramStore(3)
    put(store, to=1)
    put(store, to=2)
    put(store)
    lost, received, broadcast = store.batch()
    store.due(received)
    datagram = store.settle(lost)
    assert datagram is not None
    assert (datagram.sender, datagram.to) == (0, 1)
    assert store.settle(received) is None
    assert store.settle(broadcast) is None


def test_messages_of_agents_take_no_room_of_programs() -> None:
    store = DatagramStore(1)
    numbers = [store.speak(0, b"said") for _ in range(MOST + 1)]
    assert put(store)
    assert max(numbers) < min(store.batch())
    for number in numbers:
        store.mark_delivered(number)
    assert len(store) == 1


@given(st.data())
def test_nothing_is_lost_doubled_or_out_of_its_senders_order(data: st.DataObject) -> None:
    vehicles = data.draw(st.integers(1, 5))
    store = DatagramStore(vehicles, payloads=data.draw(st.booleans()))
    offered: list[list[int]] = [[] for _ in range(vehicles)]
    taken: list[list[int]] = [[] for _ in range(vehicles)]
    offers = st.lists(st.tuples(st.integers(0, vehicles - 1), st.integers(0, 40_000), st.integers(0, 1000)), max_size=60)
    count = 0
    for _ in range(data.draw(st.integers(1, 4))):
        for sender, size, came_ns in data.draw(offers):
            if put(store, sender, size, came_ns=came_ns):
                offered[sender].append(count)
                count += 1
        for number in store.batch():
            taken[store[number].sender].append(number)
    while numbers := store.batch():
        assert numbers == sorted(numbers)
        for number in numbers:
            taken[store[number].sender].append(number)
    assert taken == offered
    for own in taken:
        times = [store[number].came_ns for number in own]
        assert times == sorted(times)
        finish(store, own)
    assert len(store) == 0
    assert all(put(store, sender, size=datagram_store.MOST_BYTES) for sender in range(vehicles))  # all room is free again
