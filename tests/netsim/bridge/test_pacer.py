import asyncio
import socket
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.netsim.bridge.datagram_store import Pacer, TimedDelivery, new_loop


class Turning:
    """Event loop with a clock set by the test; callbacks run when their time has come."""

    def __init__(self) -> None:
        self.now_ns = 0
        self._calls: list[tuple[int, Handle]] = []

    def call_later(self, seconds: float, call: Callable[[], None]) -> "Handle":
        handle = Handle(call)
        self._calls.append((self.now_ns + round(seconds * 1e9), handle))
        return handle

    def call_soon(self, call: Callable[[], None]) -> "Handle":
        return self.call_later(0.0, call)

    def turn_until(self, now_ns: int) -> None:
        self.now_ns = max(self.now_ns, now_ns)
        while ready := [each for each in self._calls if each[0] <= self.now_ns or each[1].cancelled]:
            self._calls = [each for each in self._calls if each not in ready]
            for _, handle in ready:
                if not handle.cancelled:
                    handle.call()


class Handle:
    def __init__(self, call: Callable[[], None]) -> None:
        self.call, self.cancelled = call, False

    def cancel(self) -> None:
        self.cancelled = True


steps = st.lists(
    st.tuples(st.lists(st.tuples(st.integers(0, 1000), st.integers(0, 5)), max_size=6), st.integers(0, 300)), min_size=1
)


@given(steps)
def test_deliveries_leave_once_never_early_and_in_order(script: list) -> None:  # type: ignore[type-arg]
    loop, left = Turning(), list[TimedDelivery]()
    pacer = Pacer(loop, left.append, lambda: loop.now_ns)  # type: ignore[arg-type]
    added: list[TimedDelivery] = []
    for deliveries, pause_ns in [*script, ([], 2000)]:
        for after_ns, number in deliveries:
            added.append(TimedDelivery(after_ns, number, len(added), 0))
            pacer.put(added[-1])
        pacer.arm()
        before = len(left)
        loop.turn_until(loop.now_ns + pause_ns)
        assert sorted(left) == sorted(each for each in added if each.at_ns <= loop.now_ns)
        assert left[before:] == sorted(left[before:])
    assert len(left) == len(added)


def test_a_delivery_that_fails_delays_no_other() -> None:
    loop, left = Turning(), list[int]()

    def leave(delivery: TimedDelivery) -> None:
        left.append(delivery.row)
        if delivery.row == 1:
            raise RuntimeError("no luck")

    pacer = Pacer(loop, leave, lambda: loop.now_ns)  # type: ignore[arg-type]
    for row in range(3):
        pacer.put(TimedDelivery(10 * row, 0, row, 0))
    pacer.arm()
    loop.turn_until(9)
    with pytest.raises(RuntimeError, match="no luck"):
        loop.turn_until(10)
    loop.turn_until(20)
    assert left == [0, 1, 2]


async def test_late_deliveries_leave_in_order_and_let_other_tasks_run() -> None:
    left: list[TimedDelivery] = []
    pacer = Pacer(asyncio.get_running_loop(), left.append)
    for row in reversed(range(1000)):
        pacer.put(TimedDelivery(row, row, row, 0))
    pacer.arm()
    await asyncio.sleep(0)
    await asyncio.sleep(0)
    assert 0 < len(left) < 1000
    while len(left) < 1000:
        await asyncio.sleep(0)
    assert left == sorted(left)


def test_the_loop_wakes_for_timers_and_arrivals() -> None:
    loop = new_loop()

    async def trial() -> bytes:
        reader, writer = await asyncio.open_connection(sock=here)
        await asyncio.sleep(0.0001)
        loop.call_later(0.001, there.send, b"hello")
        answer = await asyncio.wait_for(reader.read(5), 10.0)
        writer.close()
        return answer

    here, there = socket.socketpair()
    with there:
        assert loop.run_until_complete(trial()) == b"hello"
    loop.close()
