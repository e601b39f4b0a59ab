"""Losses of walls: slab, tables of materials, and range of the radio through walls of a world."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import along_x, send
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.impairments.delay import NoDelay
from vcmvsp.netsim.impairments.loss import NoLoss
from vcmvsp.netsim.interfaces.layers import Bools, Floats, Radio
from vcmvsp.netsim.phy.dsss import Dsss
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT, LogDistance
from vcmvsp.netsim.propagation.walls import ITU_MATERIALS, Bodies, FixedWalls, ItuWalls, slab_loss_db, through


class Across:
    """Walls across the x axis, one at every tenth metre from x = 5 on."""

    def __init__(self, *materials: str, thickness_m: float = 0.2) -> None:
        self.materials = materials
        self.thickness_m: Floats = np.full(len(materials), thickness_m)

    def crossings(self, tx: Floats, rx: Floats) -> tuple[Bools, Floats]:
        walls = 5.0 + 10.0 * np.arange(len(self.materials))
        low, high = np.minimum(tx[0], rx[:, :1]), np.maximum(tx[0], rx[:, :1])
        crossed: Bools = (low < walls) & (walls < high)
        return crossed, crossed * self.thickness_m


def transmitted(material: str, thickness_m: float, frequency_hz: float, extra_turns: Floats) -> Floats:
    """Power through a slab by the exact coefficient of ITU-R P.2040-3, (43): the echoes' phase is turned further."""
    a, b, c, d = ITU_MATERIALS[material]
    f = frequency_hz * 1e-9
    n = np.sqrt(a * f**b - 17.98j * c * f**d / f)
    r = (1.0 - n) / (1.0 + n)
    passage = np.exp(-2j * np.pi * frequency_hz / SPEED_OF_LIGHT * thickness_m * n - 1j * np.pi * extra_turns)
    return np.abs((1.0 - r**2) * passage / (1.0 - (r * passage) ** 2)) ** 2


@pytest.mark.parametrize("material", [name for name in ITU_MATERIALS if name != "metal"])
@pytest.mark.parametrize("frequency_hz", [1e9, 2.4e9, 5.9e9])
@pytest.mark.parametrize("thickness_m", [0.001, 0.05, 0.3])
def test_the_slab_is_the_average_of_the_exact_one_over_the_phase(
    material: str, frequency_hz: float, thickness_m: float
) -> None:
    exact = transmitted(material, thickness_m, frequency_hz, np.arange(500) / 500)
    assert slab_loss_db(material, thickness_m, frequency_hz) == pytest.approx(-10.0 * np.log10(exact.mean()), abs=1e-6)


def test_metal_is_dark_and_no_thickness_leaves_the_reflections() -> None:
    assert ItuWalls(Across("metal", thickness_m=0.001)).loss_db(along_x(10.0)).tolist() == [300.0]
    for material in ("brick", "glass"):
        assert 0.0 < slab_loss_db(material, 1e-9, 2.4e9) < 2.0


def test_walls_add_up_and_are_capped() -> None:
    walls = Across("brick", "concrete", "brick")
    brick, concrete = slab_loss_db("brick", 0.2, 2.4e9), slab_loss_db("concrete", 0.2, 2.4e9)
    expected = [0.0, brick, brick + concrete, 2 * brick + concrete]
    assert ItuWalls(walls).loss_db(along_x(1.0, 10.0, 20.0, 30.0)) == pytest.approx(expected, abs=1e-9)
    assert ItuWalls(walls, cap_db=12.0).loss_db(along_x(1.0, 30.0)).tolist() == [0.0, 12.0]
    assert FixedWalls(walls).loss_db(along_x(1.0, 10.0, 20.0, 30.0)) == pytest.approx([0.0, 6.325, 12.65, 18.975], abs=1e-12)


def test_fixed_losses_by_material() -> None:
    walls = Across("wood", "stone", "paper")
    layer = FixedWalls(walls, wall_db=1.0, materials_db={"wood": 4.0, "stone": 12.0})
    assert layer.loss_db(along_x(10.0, 20.0, 30.0)).tolist() == [4.0, 16.0, 17.0]


def test_a_material_without_a_known_loss_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"'cardboard'.*known: concrete, brick"):
        ItuWalls(Across("brick", "cardboard"))


def bodies(foot: Floats, radius_m: float = 0.5, height_m: float = 1.0) -> Bodies:
    count = len(foot)
    return Bodies(foot, np.full(count, radius_m), np.full(count, height_m), np.arange(1.0, count + 1.0))


def raised(foot: Floats, height_m: float) -> Floats:
    return foot + np.array([0.0, 0.0, height_m])


def test_only_walls_between_both_ends_attenuate() -> None:
    foot = np.array([(0.0, 0.0, 0.0), (5.0, 0.4, 0.0), (10.0, 0.0, 0.0), (7.0, -0.6, 0.0), (15.0, 0.0, 0.0), (-3.0, 0.0, 0.0)])
    loss, count = through(bodies(foot), 0, raised(foot, 0.5))
    assert count.tolist() == [0, 1, 0, 2, 0]  # to 10 m: the wall 0.4 m off the line; to 15 m: the wall at 10 m as well
    assert loss.tolist() == [0.0, 2.0, 0.0, 2.0 + 3.0, 0.0]


@pytest.mark.parametrize(("height_m", "blocked"), [(0.99, False), (1.01, True)])
def test_a_link_above_the_body_is_free(height_m: float, blocked: bool) -> None:
    foot = np.array([(0.0, 0.0, 0.0), (5.0, 0.0, 0.0), (10.0, 0.0, 0.0)])
    _, count = through(bodies(foot, height_m=height_m), 0, raised(foot, 1.0))
    assert count.tolist() == [0, int(blocked)]


def test_a_sloping_link_is_in_the_way_only_where_it_is_low_enough() -> None:
    """From 0 m to 10 m height over 10 m: below 1 m only for the first metre."""
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
