"""Orders of the operator to a run: on a wall clock that moves only while the run waits, and without a page."""

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

PATIENCE_NS = 60 * SECOND_NS  # on the test's wall clock


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
    """A view without a page: orders by wall time, s; `GONE`: the operator leaves."""

    def __init__(self, acts: Mapping[float, Sequence[Order]]) -> None:
        self.now_ns, self._acts = 0, {seconds_to_ns(when): orders for when, orders in acts.items()}
        run_end, self._viewer_end = socket.socketpair()
        self._pipe = protocol.Pipe(run_end)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._pipe.close()
        self._viewer_end.close()

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
                self._viewer_end.sendall(struct.pack("<I", len(payload)) + payload)
            if not orders:
                self._viewer_end.close()


def run(acts: Mapping[float, Sequence[Order]], scenario: dict[str, Any] = SCENARIO, **more: Any) -> vcmvsp.Result:
    with Desk(acts) as desk:
        return vcmvsp.run(scenario, view=desk, mcap=False, **more)  # type: ignore[arg-type]  # only the required methods


def interventions_of(result: vcmvsp.Result) -> list[dict[str, Any]]:
    """Interventions of the resolved scenario."""
    return tomllib.loads(result.scenario).get("intervention", [])


def test_a_paused_run_can_be_ended() -> None:
    with pytest.raises(Interrupted) as caught:
        run({0.5: [Go(paused=True)], 3.0: [End()]})
    assert caught.value.result is not None
    assert caught.value.result.metrics["duration_s"] == pytest.approx(0.5, abs=0.1)


def test_a_paused_run_continues_without_its_operator() -> None:
    lines: list[str] = []
    result = run({0.5: [Go(paused=True, speed=1.0)], 3.0: GONE}, tell=lines.append)
    assert result.metrics["duration_s"] == 2.0
    assert any("the run continues" in line for line in lines)


def test_orders_during_a_pause_are_executed_after_it() -> None:
    result = run({0.5: [Go(paused=True)], 1.0: [HaltTable(at_s=0.0, vehicles=("car1",))], 3.0: [Go(speed=1.0)]})
    (halt,) = interventions_of(result)
    assert (halt["kind"], halt["vehicles"]) == ("halt", ["car1"])
    assert halt["at_s"] == pytest.approx(0.5, abs=0.1)


def test_during_a_pause_only_one_obstacle_is_moved_to_a_place() -> None:
    moves = [MoveTable(at_s=0.0, obstacle=name, position=(9.0, 9.0)) for name in ("crate", "chest")]
    result = run({0.5: [Go(paused=True)], 1.0: moves, 3.0: [Go(speed=1.0)]})
    assert [each["obstacle"] for each in interventions_of(result)] == ["crate"]


def test_changes_that_make_planned_ones_impossible_are_refused() -> None:
    radio = {"delay": {"kind": "uniform", "from_s": 0.01, "to_s": 0.3}}
    planned = {"kind": "set", "at_s": 1.5, "key": "radio.delay.from_s", "value": 0.2}
    change = SetTable(at_s=0.0, key="radio.delay.to_s", value=0.1)
    result = run({0.5: [change]}, {**SCENARIO, "radio": radio, "intervention": [planned]})
    assert [each["key"] for each in interventions_of(result)] == ["radio.delay.from_s"]
    result = run({1.7: [msgspec.structs.replace(change, value=0.25)]}, {**SCENARIO, "radio": radio, "intervention": [planned]})
    assert [each["key"] for each in interventions_of(result)] == ["radio.delay.from_s", "radio.delay.to_s"]


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
def test_impossible_orders_are_refused_and_the_run_continues(order: Order) -> None:
    result = run({0.5: [order]})
    assert result.metrics["duration_s"] == 2.0
    assert interventions_of(result) == []


@pytest.mark.parametrize("when_s", [0.021, 1.0, 1.97])
def test_orders_at_any_instant_are_repeated_to_the_byte(when_s: float) -> None:
    live = run(
        {
            when_s: [
                HaltTable(at_s=0.0),
                OutageTable(at_s=0.0, for_s=0.3),
                SetTable(at_s=0.0, key="radio.loss.probability", value=0.9),
            ]
        }
    )
    assert len(interventions_of(live)) == 3
    again = vcmvsp.run(tomllib.loads(live.scenario), mcap=False)
    assert again.metrics == live.metrics
    assert again.scenario == live.scenario
