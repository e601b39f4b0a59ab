"""The mean levels of all links at once, for those who ask how strong a radio is heard."""

import numpy as np
import pytest

from tests.netsim.test_federate import MS, NAMES, RUN, frames, sends, states
from tests.support.netsim.channels import make_channel
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.types import Array, States
from vcmvsp.netsim.federate import RadioFederate


def levels(radio: RadioFederate, here: Event) -> Array:
    assert isinstance(here.value, States)
    return radio.levels_dbm(here.value)


@pytest.fixture
def radio() -> RadioFederate:
    federate = RadioFederate(make_channel("wifi-b-1", shadowing={"sigma_db": 4.0}))
    federate.start(RUN)
    return federate


def test_they_are_those_of_the_frames_that_are_sent(radio: RadioFederate) -> None:
    here = states(0, 0.0, 20.0, 300.0)
    step = radio.step(0, [here, *(sends(0, name) for name in NAMES)])
    found = levels(radio, here)
    assert np.isnan(np.diagonal(found)).all()
    for report in frames(step):
        columns = [NAMES.index(name) for name in report.receivers]
        assert found[NAMES.index(report.sender), columns].tolist() == report.rssi_dbm.tolist()


def test_nobody_needs_to_have_sent(radio: RadioFederate) -> None:
    near, far = (levels(radio, states(0, 0.0, x, 300.0)) for x in (20.0, 40.0))
    assert far[0, 1] < near[0, 1]
    assert far[0, 2] == near[0, 2]


def test_asking_changes_no_frame() -> None:
    def run(*, ask: bool) -> str:
        radio = RadioFederate(
            make_channel("wifi-b-1", mac={"kind": "dcf"}, shadowing={"sigma_db": 4.0}, loss={"probability": 0.3})
        )
        radio.start(RunInfo(scenario="test", seed=4, duration_ns=10**10, vehicles=NAMES))
        here = states(0, 0.0, 20.0, 60.0)
        radio.step(0, [here])
        found = []
        for k in range(60):
            now_ns = k * 50 * MS
            if ask:
                levels(radio, here)
            due = radio.step(now_ns, [sends(now_ns, name) for name in NAMES]).next_ns
            while due is not None and due < now_ns + 50 * MS:
                if ask:
                    levels(radio, here)
                step = radio.step(due, [])
                found += frames(step)
                due = step.next_ns
        return repr(found)

    assert run(ask=True) == run(ask=False)
