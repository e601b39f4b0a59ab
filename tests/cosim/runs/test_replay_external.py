"""Replay of a run with an external vehicle: its inputs come from ``hardware.mcap``, and all else follows from them."""

import io
import tempfile
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.federate import Event, RunInfo, Slot, Step
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.recording.external_inputs import Input, InputLog, read_inputs
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Fix, Odometry, VehicleState
from vcmvsp.hardware.playback import Playback

SCENARIO: dict[str, Any] = {
    "name": "hybrid",
    "duration_s": 3.0,
    "seed": 3,
    "radio": {"preset": "wifi-b-1", "loss": {"kind": "bernoulli", "probability": 0.3}},
    "agents": {"period_s": 0.1},
    "vehicle": [
        {"name": "car1", "kind": "amigobot", "agent": {"kind": "trajectory", "path": "circle", "speed": 0.2}},
        {
            "name": "car2",
            "kind": "p2dx",
            "pose": [-0.9, -0.5, 0.0],
            "sensors": {"scan": {"kind": "lms"}},
            "agent": {"kind": "leader_follower", "leader": "car1", "distance": 1.0, "bearing_deg": 30.0},
        },
    ],
}


class Robot:
    """A robot whose runs all differ: it moves at random and logs its states at the requested instants."""

    name = "hardware"
    slot = Slot.WORLD
    wake_slot = Slot.APPLY
    latest: tuple[str, ...] = ()

    def __init__(self, log: InputLog) -> None:
        self.names: tuple[str, ...] = ("car1",)
        self.reads = self.wakes = ("car1/command",)
        self._log, self._chance = log, np.random.default_rng()
        self._state = VehicleState(position=(0.0, 0.0, 0.0))
        self._yaw, self._published = 0.0, -1

    def start(self, run: RunInfo) -> int:
        self._run = run
        return 0

    def step(self, now_ns: int, inbox: Sequence[Event]) -> Step:
        events: list[Event] = []
        if now_ns % 100_000_000 == 0 and now_ns != self._published:
            self._published = now_ns
            events = list(self._publish(now_ns))
        for event in events:
            self._log.on(event.key, event.time_ns, event.value)
        return Step(events, now_ns + 50_000_000 if now_ns < self._run.duration_ns else None)

    def _publish(self, now_ns: int) -> Sequence[Event]:
        x, y, _ = self._state.position
        self._yaw += float(self._chance.normal(0.02, 0.01))
        v = 0.2 + float(self._chance.normal(0.0, 0.02))
        vx, vy = v * float(np.cos(self._yaw)), v * float(np.sin(self._yaw))
        self._state = VehicleState(
            position=(x + 0.1 * vx, y + 0.1 * vy, 0.0), velocity=(vx, vy, 0.0), attitude=quaternion_from_yaw(self._yaw)
        )
        odometry = Odometry(pose=(x, y, self._yaw), v=v, w=0.2)
        events = [Event("car1/estimate", now_ns, self._state), Event("car1/odometry", now_ns, odometry)]
        if self._chance.random() < 0.3:
            fix = Fix(time_ns=now_ns - int(self._chance.integers(10**8)), position=self._state.position, sigma_m=0.1)
            events.append(Event("car1/fix", now_ns, fix))
        return events

    def states(self, now_ns: int) -> list[VehicleState]:
        self._log.on("car1/reflected", now_ns, self._state)
        return [self._state]

    def close(self) -> None:
        self._log.close()


def opened_log() -> InputLog:
    log = InputLog()
    log.open()
    return log


def run(vehicles: Any, **changed: Any) -> tuple[bytes, str, list[Event]]:
    """``run.mcap``, the digest, and the events of a run."""
    parsed, source = scenarios.load(SCENARIO, settings=changed)
    stream, events = io.BytesIO(), list[Event]()
    with assemble(parsed, source, playback=vehicles) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        recorder = assembled.recorder(stream)

        def on(event: Event) -> None:
            recorder.on(event)
            events.append(event)

        assembled.start(kernel)
        try:
            kernel.run(on)
        finally:
            kernel.close()
        recorder.close(kernel.now_ns)
    digest: str = recorder.metrics(window=(0.0, None))["digest"]
    return stream.getvalue(), digest, events


Recorded = tuple[list[Input], tuple[bytes, str, list[Event]]]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """Inputs of the external vehicle, from the file, and the results of the run."""
    log, path = opened_log(), tmp_path_factory.mktemp("recorded") / "hardware.mcap"
    results = run(Robot(log))
    path.write_bytes(log.content)
    return read_inputs(path), results


def of(events: Sequence[Event], prefix: str) -> list[Any]:
    return [each for each in events if each.key.startswith(prefix)]


def test_an_unchanged_replay_is_equal(recorded: Recorded) -> None:
    inputs, (mcap, digest, events) = recorded
    assert run(Robot(opened_log()))[1] != digest  # two runs of a robot differ
    again = run(Playback(("car1",), inputs))
    assert again[1] == digest
    assert again[0] == mcap
    assert [(each.key, each.time_ns) for each in again[2]] == [(each.key, each.time_ns) for each in events]


def test_equal_without_bodies() -> None:
    log = opened_log()
    first = run(Robot(log), **{"physics.kind": "kinematic"})
    with tempfile.NamedTemporaryFile() as file:
        file.write(log.content)
        file.flush()
        assert run(Playback(("car1",), read_inputs(file.name)), **{"physics.kind": "kinematic"})[1] == first[1]


def test_a_changed_algorithm_meets_the_recorded_robot(recorded: Recorded) -> None:
    inputs, (_, _, before) = recorded
    now = run(Playback(("car1",), inputs), **{"vehicle.car2.agent.k1": 0.2})[2]
    for topic in ("car1/estimate", "car1/odometry", "car1/fix", "car1/command"):
        assert of(now, topic) == of(before, topic)
    assert of(now, "car2/command") != of(before, "car2/command")
    assert [each.value.position[0].tolist() for each in of(now, "world/states")] == [
        each.value.position[0].tolist() for each in of(before, "world/states")
    ]


def test_the_robot_does_not_obey_in_a_replay(recorded: Recorded) -> None:
    inputs, (_, _, before) = recorded
    now = run(Playback(("car1",), inputs), **{"vehicle.car1.agent.speed": 0.05})[2]
    assert of(now, "car1/command") != of(before, "car1/command")
    assert of(now, "car1/estimate") == of(before, "car1/estimate")


def test_agents_may_have_shorter_periods(recorded: Recorded) -> None:
    """Physics requests instants between the recorded ones: positions are interpolated."""
    inputs, _ = recorded
    shown = {
        e.time_ns: e.value.position[0]
        for e in of(run(Playback(("car1",), inputs), **{"agents.period_s": 0.05})[2], "world/states")
    }
    for now_ns in range(0, 3_000_000_000, 100_000_000):
        between = 0.5 * (shown[now_ns] + shown[now_ns + 100_000_000])
        np.testing.assert_allclose(shown[now_ns + 50_000_000], between, atol=1e-12)


def test_after_the_recording_the_robot_stands(recorded: Recorded) -> None:
    """As after an interrupted run; the other vehicles continue."""
    inputs, lines = [each for each in recorded[0] if each[1] <= 1_500_000_000], list[str]()
    events = run(Playback(("car1",), inputs, tell=lines.append))[2]
    assert lines == ["the recording ends at 1.500 s: car1 stands still from then on"]
    states = {each.time_ns: each.value for each in of(events, "world/states")}
    for now_ns in range(1_600_000_000, 3_000_000_001, 100_000_000):
        np.testing.assert_array_equal(states[now_ns].position[0], states[1_500_000_000].position[0])
        np.testing.assert_array_equal(states[now_ns].velocity[0], np.zeros(3))
    assert of(events, "car1/estimate")[-1].time_ns == 1_500_000_001
    assert of(events, "car1/command")[-1].time_ns == 2_900_000_000
