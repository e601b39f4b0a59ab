"""What the one who looks orders of a run: on a wall clock that moves only while the run waits, and without a page."""

import socket
import struct
import tomllib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Self

import msgspec
import pytest

import vcmvsp
from vcmvsp.cosim.assembly.run import AssembledRun, Parts
from vcmvsp.cosim.clock import SECOND_NS, LiveClock, seconds_to_ns
from vcmvsp.cosim.errors import Interrupted
from vcmvsp.cosim.scenario.schema import HaltTable, MoveTable, OutageTable, SetTable
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.live.feed import Feed
from vcmvsp.cosim.view.live.session import Live
from vcmvsp.cosim.view.messages import End, Go, Order
from vcmvsp.cosim.view.scenery import scenery_of

PATIENCE_NS = 60 * SECOND_NS  # of the wall that moves


def movable(name: str, y: float) -> dict[str, Any]:
    return {"name": name, "mass_kg": 1.0, "solid": {"kind": "box", "center": [5.0, y, 0.2], "size": [0.4, 0.4, 0.4]}}


SCENARIO: dict[str, Any] = {
    "name": "looked-at",
    "duration_s": 2.0,
    "physics": {"kind": "kinematic"},
    "world": {"kind": "boxes", "boxes": [], "movables": [movable("crate", 0.0), movable("chest", 2.0)]},
    "radio": {"loss": {"kind": "bernoulli", "probability": 0.2}},
    "vehicle": [
        {"name": "car1", "kind": "kinematic", "agent": {"kind": "trajectory", "path": "circle"}},
        {"name": "car2", "kind": "kinematic", "pose": [0.0, -1.0, 0.0], "agent": {"kind": "leader_follower", "leader": "car1"}},
    ],
}
GONE: Sequence[Order] = ()


class Desk:
    """A view without a page: what is ordered when, s of the wall; `GONE`: from then on nobody is there."""

    def __init__(self, acts: Mapping[float, Sequence[Order]]) -> None:
        self.now_ns, self._acts = 0, {seconds_to_ns(when): orders for when, orders in acts.items()}
        ours, self._theirs = socket.socketpair()
        self._pipe = protocol.Pipe(ours)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._theirs.close()

    def prepare(self, parts: Parts) -> None:
        """A page that opens before the agents have joined."""

    def live(
        self, run: AssembledRun, speed: float | None, *, stop: Callable[[], None], tell: Callable[[str], None], clock: object
    ) -> Live:
        scenery = scenery_of(run.scenario, run.source, world=run.world, live=True)
        feed = Feed(self._pipe, scenery, clock=lambda: self.now_ns / SECOND_NS)

        def paced(listen: Callable[[], None]) -> LiveClock:
            return LiveClock(speed, listen, now=lambda: self.now_ns, sleep=self._sleep)

        return Live(feed, run.operator, clock=paced, stop=stop, tell=tell)

    def _sleep(self, seconds: float) -> None:
        self.now_ns += max(1, round(seconds * SECOND_NS))
        assert self.now_ns < PATIENCE_NS, "the run waits for ever"
        for when in [each for each in self._acts if each <= self.now_ns]:
            orders = self._acts.pop(when)
            for order in orders:
                payload = codec.encode(order)
                self._theirs.sendall(struct.pack("<I", len(payload)) + payload)
            if not orders:
                self._theirs.close()


def run(acts: Mapping[float, Sequence[Order]], scenario: dict[str, Any] = SCENARIO, **more: Any) -> vcmvsp.Result:
    with Desk(acts) as desk:
        return vcmvsp.run(scenario, view=desk, mcap=False, **more)  # type: ignore[arg-type]  # as much of it as is needed


def done(result: vcmvsp.Result) -> list[dict[str, Any]]:
    """What the resolved scenario says was done."""
    return tomllib.loads(result.scenario).get("intervention", [])


def test_a_run_that_stands_still_can_be_ended() -> None:
    with pytest.raises(Interrupted) as caught:
        run({0.5: [Go(paused=True)], 3.0: [End()]})
    assert caught.value.result is not None
    assert caught.value.result.metrics["duration_s"] == pytest.approx(0.5, abs=0.1)


def test_a_run_does_not_stand_still_for_one_who_has_gone() -> None:
    told: list[str] = []
    result = run({0.5: [Go(paused=True, speed=1.0)], 3.0: GONE}, tell=told.append)
    assert result.metrics["duration_s"] == 2.0
    assert any("the run continues" in line for line in told)


def test_what_is_ordered_while_it_stands_still_is_done_when_it_goes_on() -> None:
    result = run({0.5: [Go(paused=True)], 1.0: [HaltTable(at_s=0.0, vehicles=("car1",))], 3.0: [Go(speed=1.0)]})
    (halt,) = done(result)
    assert (halt["kind"], halt["vehicles"]) == ("halt", ["car1"])
    assert halt["at_s"] == pytest.approx(0.5, abs=0.1)


def test_two_things_are_not_put_into_one_place_while_it_stands_still() -> None:
    moves = [MoveTable(at_s=0.0, obstacle=name, position=(9.0, 9.0)) for name in ("crate", "chest")]
    result = run({0.5: [Go(paused=True)], 1.0: moves, 3.0: [Go(speed=1.0)]})
    assert [each["obstacle"] for each in done(result)] == ["crate"]


def test_nothing_is_changed_that_would_make_impossible_what_is_planned() -> None:
    radio = {"delay": {"kind": "uniform", "from_s": 0.01, "to_s": 0.3}}
    planned = {"kind": "set", "at_s": 1.5, "key": "radio.delay.from_s", "value": 0.2}
    change = SetTable(at_s=0.0, key="radio.delay.to_s", value=0.1)
    result = run({0.5: [change]}, {**SCENARIO, "radio": radio, "intervention": [planned]})
    assert [each["key"] for each in done(result)] == ["radio.delay.from_s"]
    result = run({1.7: [msgspec.structs.replace(change, value=0.25)]}, {**SCENARIO, "radio": radio, "intervention": [planned]})
    assert [each["key"] for each in done(result)] == ["radio.delay.from_s", "radio.delay.to_s"]


@pytest.mark.parametrize(
    "order",
    [
        HaltTable(at_s=0.0, vehicles=("nobody",)),
        HaltTable(at_s=0.0, vehicles=("nobody",) * 10_000),
        OutageTable(at_s=0.0, for_s=1e12),
        OutageTable(at_s=0.0, for_s=-1.0),
        SetTable(at_s=0.0, key="radio.loss.probability", value=1e300),
        SetTable(at_s=0.0, key="duration_s", value=1.0),
        MoveTable(at_s=0.0, obstacle="crate", position=(float("nan"), 0.0)),
        MoveTable(at_s=0.0, obstacle="nothing", position=(0.0, 0.0)),
        Go(speed=1e-300),
        Go(speed=float("nan")),
        Go(speed=-1.0),
    ],
    ids=str,
)
def test_what_cannot_be_done_is_not_done_and_the_run_goes_on(order: Order) -> None:
    result = run({0.5: [order]})
    assert result.metrics["duration_s"] == 2.0
    assert done(result) == []


@pytest.mark.parametrize("when_s", [0.021, 1.0, 1.97])
def test_what_was_ordered_at_any_instant_is_repeated_to_the_byte(when_s: float) -> None:
    live = run(
        {
            when_s: [
                HaltTable(at_s=0.0),
                OutageTable(at_s=0.0, for_s=0.3),
                SetTable(at_s=0.0, key="radio.loss.probability", value=0.9),
            ]
        }
    )
    assert len(done(live)) == 3
    again = vcmvsp.run(tomllib.loads(live.scenario), mcap=False)
    assert again.metrics == live.metrics
    assert again.scenario == live.scenario
