"""Paths: closed forms of images, slabs on the path, roofs; compiled and interpreted results are equal."""

import math

import numpy as np
import pytest

from tests.support.netsim.ray_worlds import kinds, rays_among, trace_paths
from vcmvsp.cosim.compiled.machine_code import available
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.netsim.interfaces.layers import Frame, Paths, SenderLinks
from vcmvsp.netsim.propagation.path_loss import SPEED_OF_LIGHT, Friis
from vcmvsp.netsim.propagation.rays.coefficients import half_space, permittivity, slab
from vcmvsp.netsim.propagation.rays.loss import Geometric, band_power
from vcmvsp.physics.world.solids import Box, Cylinder, Mesh, Prism

WAVE_M = SPEED_OF_LIGHT / 2.4e9
WALL = Box(center=(0.0, 5.0, 2.0), size=(40.0, 0.2, 4.0), material="brick")


def test_without_solids_it_is_free_space() -> None:
    paths = Paths.between(np.array([1.0, 2.0, 3.0]), np.array([[4.0, 6.0, 3.0], [100.0, 2.0, 3.0]]))
    assert rays_among().loss_db(paths) == pytest.approx(Friis(2.4e9).loss_db(paths), abs=1e-9)


def test_two_rays_over_the_ground() -> None:
    """Level, vertically polarised antennas: the direct ray, and one over the image below the ground."""
    d, high, low = 40.0, 3.0, 1.0
    found = trace_paths(rays_among(ground="medium_dry_ground"), [0.0, 0.0, high], [d, 0.0, low])
    assert kinds(found) == ["", "S"]
    lengths = [math.hypot(d, high - low), math.hypot(d, high + low)]
    assert found.table.length_m.tolist() == pytest.approx(lengths)
    assert found.table.point[1, 0].tolist() == pytest.approx([d * high / (high + low), 0.0, 0.0])
    _, reflected, _ = half_space((high + low) / lengths[1], permittivity("medium_dry_ground", 2.4e9))
    expected = WAVE_M / (4.0 * math.pi * lengths[1]) * reflected * np.exp(-2j * math.pi * lengths[1] / WAVE_M)
    assert found.table.gain[1] == pytest.approx(expected, rel=1e-9)


def test_paths_between_two_walls_are_the_images_of_a_corridor() -> None:
    corridor = [Box(center=(0.0, y, 5.0), size=(400.0, 2.0, 1000.0), material="metal") for y in (-4.0, 6.0)]
    found = trace_paths(rays_among(*corridor, reflections=3, diffraction=False), [0.0, 0.0, 0.0], [30.0, 1.0, 0.0])
    assert sorted(kinds(found)) == ["", "S", "S", "SS", "SS", "SSS", "SSS"]
    # Walls at -3 and 5: the images of y = 1 are at 1 + 16 k and at -7 - 16 k, 9 + 16 k.
    images = [1.0, -7.0, 9.0, 17.0, -15.0, -23.0, 25.0]
    assert sorted(found.table.length_m) == pytest.approx(sorted(math.hypot(30.0, y) for y in images))


def test_a_slab_in_the_way() -> None:
    found = trace_paths(rays_among(WALL, diffraction=False), [0.0, 0.0, 2.0], [3.0, 9.0, 2.0])
    assert kinds(found) == [""]
    assert found.table.pass_at.tolist() == pytest.approx([5.0 / 9.0])
    through = slab(9.0 / math.hypot(3.0, 9.0), permittivity("brick", 2.4e9), 0.2 / WAVE_M, averaged=0)[2]
    expected = WAVE_M / (4.0 * math.pi * math.hypot(3.0, 9.0)) * abs(through)  # the field is vertical
    assert abs(found.table.gain[0]) == pytest.approx(expected, rel=1e-9)


def test_opaque_where_it_is_thicker_than_the_limit() -> None:
    for keys in ({"slab_m": 0.2}, {"transmission": False}):
        assert not kinds(trace_paths(rays_among(WALL, diffraction=False, **keys), [0.0, 0.0, 2.0], [0.0, 9.0, 2.0]))


def test_thin_solids_of_any_shape_let_a_share_through() -> None:
    post = Cylinder(center=(0.0, 5.0, 2.0), radius=0.1, height=4.0, material="wood")
    ring = ((-2.0, 4.0), (2.0, 4.0), (2.0, 7.0), (-2.0, 7.0)), (((-1.9, 4.1), (-1.9, 6.9), (1.9, 6.9), (1.9, 4.1)),)
    room = Prism(outline=ring[0], holes=ring[1], height=4.0, material="wood")
    for solid, walls in ((post, 1), (room, 2)):
        found = trace_paths(rays_among(solid, diffraction=False, reflections=0), [0.01, 0.0, 2.0], [0.02, 9.0, 2.0])
        assert (kinds(found), len(found.table.pass_path)) == ([""], walls)


def test_a_mesh_and_a_box_have_the_same_paths() -> None:
    box = Box(center=(0.0, 6.0, 3.0), size=(8.0, 4.0, 6.0), material="brick")
    x, y, z = (np.array([-1.0, 1.0]) * 0.5 * size + middle for size, middle in zip(box.size, box.center, strict=True))
    corner = np.array([(x[i], y[j], z[k]) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = np.array([[a, b, c] for p, q, r, s in quads for a, b, c in ((p, q, r), (p, r, s))])
    mesh = Mesh(triangles=corner[triangles], material="brick")
    a, b = np.array([(-7.0, 1.3, 1.0), (5.1, 11.0, 1.5)]), np.array([(6.3, 0.4, 2.0), (-8.0, 2.0, 0.7)])
    of_box, of_mesh = (trace_paths(rays_among(solid, ground="concrete"), a, b) for solid in (box, mesh))
    assert sorted(np.abs(of_mesh.table.gain)) == pytest.approx(sorted(np.abs(of_box.table.gain)), rel=1e-9)


def test_a_knife_edge_where_nothing_else_arrives() -> None:
    """ITU-R P.526-15, equations 26 and 31, of one edge; no other path arrives."""
    fence = Box(center=(0.0, 0.0, 5.0), size=(0.2, 1000.0, 10.0), material="metal")
    rays = rays_among(fence, diffraction=False)
    found = trace_paths(rays, [-30.0, 0.0, 2.0], [50.0, 0.0, 4.0])
    assert not len(found.table.pair)
    assert found.roofs.edge[0].tolist() == pytest.approx([0.0, 0.0, 10.0])
    height = 10.0 - (2.0 + 2.0 * 30.0 / 80.0)
    nu = height * math.sqrt(2.0 / WAVE_M * (1.0 / 30.0 + 1.0 / 50.0))
    loss = 6.9 + 20.0 * math.log10(math.hypot(nu - 0.1, 1.0) + nu - 0.1)
    free = 20.0 * math.log10(4.0 * math.pi * math.hypot(80.0, 2.0) / WAVE_M)
    paths = Paths.between(np.array([-30.0, 0.0, 2.0]), np.array([[50.0, 0.0, 4.0]]))
    assert rays.loss_db(paths)[0] == pytest.approx(free + loss, abs=1e-9)


@pytest.mark.slow
def test_compiled_and_interpreted_search_agree_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VCMVSP_COMPILED", "1")
    if not available():
        pytest.skip("nothing is compiled here")
    solids = (WALL, Box(center=(3.0, -6.0, 2.0), size=(5.0, 3.0, 4.0)))
    rng = np.random.default_rng(1)
    a, b = rng.uniform([-9.0, -3.0, 0.2], [9.0, 4.0, 3.0], (2, 60, 3))
    found = []
    for compiled in (False, True):
        monkeypatch.setenv("VCMVSP_COMPILED", str(int(compiled)))
        rays = rays_among(*solids, ground="concrete")
        if compiled:
            rays.prepare()
            Geometric(rays).prepare()
        links, _ = rays.links(Paths.between(a[0], b))
        found.append([*rays.traced(a, b).table, *links[:-1], band_power(links, 20e6)])
    for interpreted, machine in zip(*found, strict=True):
        assert interpreted.tobytes() == machine.tobytes()


def test_links_of_all_radios_equal_links_of_each() -> None:
    """The second query has all links computed: both directions, and both ways of computing, agree."""
    rays = rays_among(WALL, ground="concrete")
    places = np.random.default_rng(3).uniform([-9.0, -3.0, 0.2], [9.0, 9.0, 3.0], (6, 3))
    loss = np.full((6, 6), np.nan)
    for row in range(6):
        others = np.delete(np.arange(6), row)
        loss[row, others] = rays.loss_db(Paths.between(places[row], places[others]))
        alone = rays_among(WALL, ground="concrete").loss_db(Paths.between(places[row], places[others]))
        assert loss[row, others].tolist() == alone.tolist()
    assert np.nanmax(np.abs(loss - loss.T)) < 1e-9


def test_geometric_fading_of_two_paths() -> None:
    """Two waves interfere; over a bandwidth much wider than c / path difference they add up by power."""
    rays = rays_among(ground="metal")
    paths = Paths.between(np.array([0.0, 0.0, 3.0]), np.array([[40.0, 0.0, 1.0], [41.0, 0.0, 1.5]]))
    frame = Frame(0, 0, 1, 1, paths, np.zeros(2), SenderLinks(0, "a", ("b", "c")))
    found = trace_paths(rays, np.tile(paths.tx, (2, 1)), paths.rx)
    waves = found.table.gain.reshape(2, 2)
    expected = 20.0 * np.log10(np.abs(waves.sum(axis=1))) - 10.0 * np.log10((np.abs(waves) ** 2).sum(axis=1))

    def gain(bandwidth_hz: float) -> np.ndarray:
        return Geometric(rays, bandwidth_hz).gain_db(frame, lambda: np.zeros((2, 2)))

    assert gain(1.0) == pytest.approx(expected, abs=1e-6)
    assert gain(1e14) == pytest.approx(np.zeros(2), abs=0.01)


def test_delays_of_two_paths_over_metal() -> None:
    """The direct path is first; for two travel times with power shares p and 1 - p the spread is sqrt(p (1 - p)) of their
    difference.
    """
    rays, far = rays_among(ground="metal"), np.array([[40.0, 0.0, 1.0], [0.5, 0.0, 2.0]])
    paths = Paths.between(np.array([0.0, 0.0, 3.0]), far)
    first_ns, spread_ns = rays.delays_ns(paths)
    assert first_ns == pytest.approx(paths.distance_m / SPEED_OF_LIGHT * 1e9)
    share = np.abs(trace_paths(rays, np.tile(paths.tx, (2, 1)), far).table.gain.reshape(2, 2)) ** 2
    share /= share.sum(axis=1, keepdims=True)
    apart_ns = (np.hypot(far[:, 0], 3.0 + far[:, 2]) - paths.distance_m) / SPEED_OF_LIGHT * 1e9
    assert spread_ns == pytest.approx(np.sqrt(share[:, 0] * share[:, 1]) * apart_ns)


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"ground": "cheese"}, "ground: must be none or one of concrete"),
        ({"facet_limit": 3}, "the world has 5 facets, more than facet_limit = 3"),
    ],
)
def test_bad_keys(keys: dict[str, object], words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        rays_among(Box(center=(0, 0, 1), size=(2, 2, 2)), **{"ground": "concrete", **keys})


def test_a_solid_without_a_known_material() -> None:
    with pytest.raises(ScenarioError, match=r"the box at \(0, 0, 1\).* is of 'cheese', whose permittivity is not known"):
        rays_among(Box(center=(0, 0, 1), size=(2, 2, 2), material="cheese"))
