"""Vehicles in the way of links between others."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import send
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.impairments.delay import NoDelay
from vcmvsp.netsim.impairments.loss import NoLoss
from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.interfaces.radio import Radio
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.propagation.path_loss import LogDistance
from vcmvsp.netsim.propagation.walls import Bodies, through


def bodies(foot: Floats, radius_m: float = 0.5, height_m: float = 1.0) -> Bodies:
    count = len(foot)
    return Bodies(foot, np.full(count, radius_m), np.full(count, height_m), np.arange(1.0, count + 1.0))


def raised(foot: Floats, height_m: float) -> Floats:
    higher: Floats = foot + np.array([0.0, 0.0, height_m])
    return higher


def test_who_stands_between_is_in_the_way_and_nobody_else() -> None:
    foot = np.array([(0.0, 0.0, 0.0), (5.0, 0.4, 0.0), (10.0, 0.0, 0.0), (7.0, -0.6, 0.0), (15.0, 0.0, 0.0), (-3.0, 0.0, 0.0)])
    loss, count = through(bodies(foot), 0, raised(foot, 0.5))
    assert count.tolist() == [0, 1, 0, 2, 0]  # to 10 m: the one that is 0.4 m off the line; to 15 m: the one at 10 m as well
    assert loss.tolist() == [0.0, 2.0, 0.0, 2.0 + 3.0, 0.0]


@pytest.mark.parametrize(("height_m", "blocked"), [(0.99, False), (1.01, True)])
def test_a_link_above_the_body_is_free(height_m: float, blocked: bool) -> None:
    foot = np.array([(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (10.0, 0.0, 0.0)])
    _, count = through(bodies(foot, height_m=height_m), 0, raised(foot, 1.0))
    assert count.tolist() == [0, int(blocked)]


def test_a_sloping_link_is_in_the_way_only_where_it_is_low_enough() -> None:
    """From 0 m to 10 m height over 10 m: it is below 1 m for the first metre."""
    antennas = np.array([(0.0, 0.0, 0.0), (10.0, 0.0, 10.0), (1.4, 0.0, 5.0), (1.6, 0.0, 5.0)])
    foot = antennas * (1.0, 1.0, 0.0)
    assert through(bodies(foot)._replace(radius_m=np.array([0.1, 0.1, 0.5, 0.1])), 0, antennas)[1].tolist() == [1, 0, 0]
    assert through(bodies(foot)._replace(radius_m=np.array([0.1, 0.1, 0.1, 0.5])), 0, antennas)[1].tolist() == [0, 0, 0]


POINTS: st.SearchStrategy[Floats] = st.lists(st.tuples(*[st.floats(-5.0, 5.0)] * 3), min_size=2, max_size=6).map(np.array)


@given(POINTS)
def test_there_and_back_are_the_same(foot: Floats) -> None:
    antennas = raised(foot, 0.3)
    losses = [np.insert(through(bodies(foot), row, antennas)[0], row, 0.0) for row in range(len(foot))]
    assert np.array_equal(np.array(losses), np.array(losses).T)


def test_the_channel_counts_them_among_the_walls() -> None:
    radios = {f"car{i}": Radio(body_loss_db=60.0 if i == 1 else 0.0) for i in range(3)}
    channel = Channel(path_loss=LogDistance(), phy=Dsss(), loss=NoLoss(), delay=NoDelay(), radios=radios)
    report = send(channel, 5.0, 10.0)
    assert report.outcome == ("received", "walls")
    assert report.wall_materials == ("", "1 vehicle")
    assert report.wall_loss_db is not None
    assert report.walls is not None
    assert (report.wall_loss_db.tolist(), report.walls.tolist()) == ([0.0, 60.0], [0, 1])
