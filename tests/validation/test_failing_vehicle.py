"""A vehicle that fails in a run: its agent is no longer called, its last command counts, and it sends nothing."""

import numpy as np
import pytest

import vcmvsp
from tests.support.cosim.memory_links import behind_the_wire
from tests.support.validation.fleets import fleet, poses

DIES_S = 4.0


@pytest.mark.parametrize("latency_s", [0.0, 0.25])
def test_a_failed_vehicle_stands_still_and_sends_nothing(latency_s: float) -> None:
    scenario = fleet(8.0, radio={"preset": "ideal"})
    scenario["agents"] = {"latency_s": latency_s}
    scenario["vehicle"][0]["agent"]["fails_s"] = DIES_S
    result = vcmvsp.run(scenario, mcap=False)
    times, moved = poses(result)
    stands = times >= DIES_S + latency_s
    assert (moved[stands, 0] == moved[stands, 0][0]).all()
    assert (moved[~stands, 0][1:] != moved[~stands, 0][:-1]).any(axis=1)[-3:].all()  # moving until then
    sent = result.radio.to_pandas().query("sender == 'car1'").sent_ns / 1e9
    assert sent.max() == pytest.approx(DIES_S - 0.1 + latency_s)


def test_a_failure_does_not_depend_on_the_process() -> None:
    scenario = fleet(6.0, radio={"preset": "ideal"})
    scenario["vehicle"][1]["agent"]["fails_s"] = 3.0
    digest = vcmvsp.run(scenario, mcap=False).metrics["digest"]
    with behind_the_wire():
        assert vcmvsp.run(scenario, mcap=False).metrics["digest"] == digest
    assert "fails_s = 3.0" in vcmvsp.run(scenario, mcap=False).scenario


def test_answers_of_a_failed_follower_are_not_awaited() -> None:
    """Five times ``silence_s`` after the failure, reports are as rare as before, and none is repeated."""
    scenario = fleet(60.0, path="straight", radio={"preset": "ideal"})
    scenario["agents"] = {"sending": {"when": "needed"}, "formation": {"shape": "wedge"}}
    for vehicle in scenario["vehicle"][1:]:
        vehicle["agent"] = {"kind": "leader_follower"}
    scenario["vehicle"][2]["agent"]["fails_s"] = 20.0
    sent_ns = vcmvsp.run(scenario, mcap=False).radio.to_pandas().query("sender == 'car1'").sent_ns.unique()
    often, rare = (np.count_nonzero((sent_ns >= begin * 1e9) & (sent_ns < end * 1e9)) for begin, end in ((20, 30), (32, 60)))
    assert often > 30  # every answer_s
    assert rare <= 15  # every silence_s


def test_a_vehicle_failed_off_its_slot_never_settles() -> None:
    for at_s, settles in ((1.0, False), (15.0, True)):
        scenario = fleet(20.0, [{"pose": (-1.5, 0.0, 0.0)}], path="straight", radio={"preset": "ideal"})
        scenario["vehicle"][1]["agent"]["fails_s"] = at_s
        formation = vcmvsp.run(scenario, mcap=False).metrics["formation"]
        assert (formation["settling_s"] is not None) == settles
