"""A vehicle that dies in a run: its agent is not asked any more, its last orders count, and nothing is heard of it."""

import numpy as np
import pytest

import vcmvsp
from tests.support.cosim.memory_links import behind_the_wire
from tests.support.validation.fleets import fleet, poses

DIES_S = 4.0


@pytest.mark.parametrize("latency_s", [0.0, 0.25])
def test_a_dead_vehicle_stands_still_and_sends_nothing(latency_s: float) -> None:
    scenario = fleet(8.0, radio={"preset": "ideal"})
    scenario["agents"] = {"latency_s": latency_s}
    scenario["vehicle"][0]["agent"]["fails_s"] = DIES_S
    result = vcmvsp.run(scenario, mcap=False)
    times, moved = poses(result)
    stands = times >= DIES_S + latency_s
    assert (moved[stands, 0] == moved[stands, 0][0]).all()
    assert (moved[~stands, 0][1:] != moved[~stands, 0][:-1]).any(axis=1)[-3:].all()  # until then it moves
    sent = result.radio.to_pandas().query("sender == 'car1'").sent_ns / 1e9
    assert sent.max() == pytest.approx(DIES_S - 0.1 + latency_s)


def test_it_does_not_matter_where_it_dies() -> None:
    scenario = fleet(6.0, radio={"preset": "ideal"})
    scenario["vehicle"][1]["agent"]["fails_s"] = 3.0
    digest = vcmvsp.run(scenario, mcap=False).metrics["digest"]
    with behind_the_wire():
        assert vcmvsp.run(scenario, mcap=False).metrics["digest"] == digest
    assert "fails_s = 3.0" in vcmvsp.run(scenario, mcap=False).scenario


def test_who_waits_for_answers_gives_up_one_that_is_dead() -> None:
    """Five times ``silence_s`` after its death reports are as rare again as they were, and none is repeated for its sake."""
    scenario = fleet(60.0, path="straight", radio={"preset": "ideal"})
    scenario["agents"] = {"sending": {"when": "needed"}, "formation": {"shape": "wedge"}}
    for vehicle in scenario["vehicle"][1:]:
        vehicle["agent"] = {"kind": "leader_follower"}
    scenario["vehicle"][2]["agent"]["fails_s"] = 20.0
    sent_ns = vcmvsp.run(scenario, mcap=False).radio.to_pandas().query("sender == 'car1'").sent_ns.unique()
    often, rare = (np.count_nonzero((sent_ns >= begin * 1e9) & (sent_ns < end * 1e9)) for begin, end in ((20, 30), (32, 60)))
    assert often > 30  # every answer_s
    assert rare <= 15  # every silence_s


def test_one_that_dies_far_from_its_place_never_settles_and_one_in_its_place_has_settled() -> None:
    for at_s, settles in ((1.0, False), (15.0, True)):
        scenario = fleet(20.0, [{"pose": (-1.5, 0.0, 0.0)}], path="straight", radio={"preset": "ideal"})
        scenario["vehicle"][1]["agent"]["fails_s"] = at_s
        formation = vcmvsp.run(scenario, mcap=False).metrics["formation"]
        assert (formation["settling_s"] is not None) == settles
