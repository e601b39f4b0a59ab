"""Frames that are decided ahead of time, between two instants at which vehicles may send, leave the same recording."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import vcmvsp
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.federate import Event, Step
from vcmvsp.cosim.types import Velocity
from vcmvsp.netsim.federate import RadioFederate

CARS = tuple(f"car{number}" for number in range(1, 6))
RADIOS: list[tuple[dict[str, Any], int]] = [  # with the longest message, bytes: the queues are never empty for long
    ({"preset": "wifi-b-1", "fading": {"kind": "rayleigh"}}, 1000),
    ({"preset": "zigbee", "fading": {"kind": "rayleigh"}}, 100),
    ({"preset": "lora-sf7"}, 50),
]


class Talker(Agent):
    """Drives on, and sends to all or to the vehicle that it heard last."""

    def __init__(self, period_s: float, longest_bytes: int) -> None:
        self.period, self._longest = period_s, longest_bytes

    def start(self, info: VehicleInfo) -> None:
        """Seed its choices."""
        self._choices = np.random.default_rng([5, len(info.vehicles), int(info.name[3:])])

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Send up to five messages."""
        senders = [reception.message.sender for reception in obs.heard]
        for size in self._choices.integers(1, self._longest, self._choices.integers(6)):
            radio.send(b"x" * int(size), to=senders[-1] if senders else None)
        return Velocity(linear=(0.5, 0.0, 0.0))


@pytest.mark.parametrize(("kind", "longest_bytes"), RADIOS, ids=["wifi", "zigbee", "lora"])
@pytest.mark.parametrize("latency_s", [0.0, 0.013])
def test_decisions_ahead_of_time_change_no_byte(
    kind: dict[str, Any], longest_bytes: int, latency_s: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With agents of two periods, losses, retries, and a recording of what vehicles hear."""
    scenario = {
        "name": "talk",
        "duration_s": 4.0,
        "physics": {"kind": "kinematic"},
        "radio": kind,
        "record": {"heard": True, "period_s": 0.07},
        "agents": {"latency_s": latency_s},
        "vehicles": {"kind": "kinematic"},
        "vehicle": [{"name": name, "position": [35.0 * i, 5.0 * i, 0.0]} for i, name in enumerate(CARS)],
    }
    steps: dict[str, list[int]] = {"ahead": [], "at their time": []}
    step = RadioFederate.step
    for way, taken in steps.items():

        def counted(radio: RadioFederate, now_ns: int, inbox: Sequence[Event], taken: list[int] = taken) -> Step:
            taken.append(now_ns)
            return step(radio, now_ns, inbox)

        with monkeypatch.context() as patch:
            patch.setattr(RadioFederate, "step", counted)
            if way != "ahead":
                patch.setattr(RadioFederate, "looks_ahead", property(lambda _: False, lambda *_: None), raising=False)
            agents = {name: Talker((0.1, 0.25)[i % 2], longest_bytes) for i, name in enumerate(CARS)}
            vcmvsp.run(scenario, agents=agents, out=tmp_path / way)
    names = ("run.mcap", "radio.parquet", "states.parquet", "metrics.json")
    first, second = ([(tmp_path / way / name).read_bytes() for name in names] for way in steps)
    assert first == second
    assert len(steps["ahead"]) < len(steps["at their time"])
