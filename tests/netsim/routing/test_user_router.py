"""User-written routers: required methods, and the error for answers that make no sense."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

from tests.support.netsim.routing_runs import MS, line, message_at, run
from vcmvsp.cosim.errors import FederateError
from vcmvsp.netsim.routing.router import BROADCAST, Router, Update


@dataclass(frozen=True)
class Mine:
    """Passes everything to the same vehicle."""

    via: Any

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        return Handing(self.via)


class Handing:
    """The minimal router."""

    hop_limit, jitter_ns = 8, 0

    def __init__(self, via: Any) -> None:
        self._via = via

    def next_hop(self, row: int, to: int, now_ns: int) -> int | None:
        return self._via

    def relays(self, row: int, by: int) -> bool:
        return True


@pytest.mark.parametrize("via", [2, np.int64(2), BROADCAST])
def test_a_router_without_updates_needs_two_methods(via: Any) -> None:
    outcome = run(Mine(via), line(3, 20.0), message_at("car1", 0, to="car3"))
    assert [each.receiver for each in outcome.routed_receptions] == ["car3"]


@pytest.mark.parametrize("via", [3, 99, -2, 0, "car2", 1.0])
def test_an_answer_that_makes_no_sense_is_an_error_with_the_name_of_the_kind(via: Any) -> None:
    with pytest.raises(FederateError) as caught:
        run(Mine(via), line(3), message_at("car1", 0, to="car3"))
    allowed = "allowed: the row of another vehicle (of 3), -1 (a broadcast) or None"
    assert str(caught.value) == f"routing Mine: returned {via!r} as the next hop of car1; {allowed}"


@dataclass(frozen=True)
class Chatty:
    """Its vehicles exchange routes without end."""

    size_bytes: int
    period_ns: int

    def open(self, vehicles: Sequence[str], seed: int) -> Router:
        return Chatting(self)


class Chatting(Handing):
    """Exchanges the allowed number of updates."""

    def __init__(self, kind: Chatty) -> None:
        super().__init__(BROADCAST)
        self._kind = kind

    def first_ns(self) -> Sequence[int]:
        return 5 * MS, 10 * MS

    def update(self, row: int, now_ns: int) -> Update:
        return Update(None, self._kind.size_bytes, now_ns + self._kind.period_ns)

    def take(self, row: int, by: int, content: Any, now_ns: int) -> None:
        assert (row, by) in ((0, 1), (1, 0))


def test_a_router_with_updates_is_called_at_its_times() -> None:
    outcome = run(Chatty(100, 300 * MS), line(2))
    assert [(each.origin, each.sent_ns // MS) for each in outcome.routed] == [
        (name, at) for k in range(4) for name, at in (("car1", 5 + 300 * k), ("car2", 10 + 300 * k))
    ]


@pytest.mark.parametrize(("size_bytes", "period_ns"), [(-1, MS), (10, 0), (10, -MS)])
def test_an_update_of_the_past_or_of_less_than_nothing_is_an_error(size_bytes: int, period_ns: int) -> None:
    with pytest.raises(
        FederateError, match=rf"^routing Chatty: returned an update of {size_bytes} bytes at 5000000 ns, the next at"
    ):
        run(Chatty(size_bytes, period_ns), line(2))
