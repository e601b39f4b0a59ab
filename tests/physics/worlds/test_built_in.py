"""Built-in worlds: no overlaps, stated sizes, free paths, reproducibility."""

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

import vcmvsp
from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util.polygons import overlap_m
from vcmvsp.physics.vehicles.models import P2DX
from vcmvsp.physics.world.floor import GroundTarget
from vcmvsp.physics.world.proximity import Blocking
from vcmvsp.physics.world.solids import Box, Cylinder, Prism, rectangle
from vcmvsp.physics.world.world import Movable, Moving, Wind, World, Zone
from vcmvsp.physics.worlds.laboratory import AISLES, PATROL, Laboratory
from vcmvsp.physics.worlds.obstacle_courses import Corridor, Gates, GatesOffset, Pillar
from vcmvsp.physics.worlds.recreation import RecreationCentre
from vcmvsp.physics.worlds.surroundings import Boxes, Empty
from vcmvsp.physics.worlds.urban import Urban

TURNS = (0.7, -1.2, 1.57)
WORLDS: dict[str, Any] = {
    "laboratory": Laboratory(),
    "recreation-centre": RecreationCentre(),
    "recreation-centre with many trees": RecreationCentre(trees=120, seed=3),
    "urban": Urban(),
    "urban of many": Urban(size=(500.0, 300.0), lots=3, gap=1.0, density=1.0, seed=8),
    "corridor": Corridor(),
    "corridor with bends": Corridor(length=40.0, bends=TURNS, closed=True),
    "gates": Gates(),
    "gates-offset": GatesOffset(number=8),
    "pillar": Pillar(),
}
built = pytest.mark.parametrize("world", [each.build() for each in WORLDS.values()], ids=WORLDS)


def overlaps(world: World) -> Iterator[tuple[int, int]]:
    """Pairs of solids that overlap, among pieces closer than their sizes."""
    pieces = [
        (corners, bottom, top, solid)
        for group in world.shapes.groups
        for corners, bottom, top, solid in zip(
            group.corners, group.bottom.tolist(), group.top.tolist(), group.solid.tolist(), strict=True
        )
    ]
    low = np.array([corners.min(axis=0) for corners, *_ in pieces])
    high = np.array([corners.max(axis=0) for corners, *_ in pieces])
    for i, (corners, bottom, top, solid) in enumerate(pieces):
        for j in np.flatnonzero((low[i] < high[i + 1 :]).all(axis=1) & (low[i + 1 :] < high[i]).all(axis=1)).tolist():
            other, other_bottom, other_top, other_solid = pieces[i + 1 + j]
            if min(top, other_top) - max(bottom, other_bottom) > 1e-9 and overlap_m(corners, other) > 1e-9:
                yield solid, other_solid


@built
def test_no_solid_is_inside_another(world: World) -> None:
    assert list(overlaps(world)) == []


def test_overlaps_are_detected() -> None:
    one, other = (Box(center=(x, 0.0, 0.5), size=(1.0, 1.0, 1.0)) for x in (0.0, 0.9))
    assert list(overlaps(World(solids=(one, other)))) == [(0, 1)]


@built
def test_everything_stands_on_or_above_the_floor_and_most_of_it_in_bounds(world: World) -> None:
    points, _ = world.mesh()
    assert points[:, 2].min() >= 0.0
    if world.bounds is not None:
        west, south, east, north = world.bounds
        inside = (points[:, 0] >= west) & (points[:, 0] <= east) & (points[:, 1] >= south) & (points[:, 1] <= north)
        assert inside.mean() > 0.97  # all except the laboratory's walls, outside its 16.4 x 9.5 m


@built
def test_resting_on_each_other_means_at_the_same_height(world: World) -> None:
    boxes = [solid for solid in world.solids if isinstance(solid, Box | Cylinder)]
    heights = {round(solid.center[2] + 0.5 * solid.hull.size[2], 6) for solid in boxes} | {0.0, 2.1}
    for solid in boxes:
        assert round(solid.center[2] - 0.5 * solid.hull.size[2], 6) in heights  # nothing floats except above the door


@pytest.mark.parametrize("kind", list(WORLDS))
def test_equal_parameters_give_equal_worlds(kind: str) -> None:
    assert WORLDS[kind].build() == WORLDS[kind].build()


BALL = {"kind": "cylinder", "center": [0, 0, 0.2], "radius": 0.2, "height": 0.4}
CUBE = {"kind": "box", "center": [0, 0, 0], "size": [1, 1, 1]}


@pytest.mark.parametrize("kind", [Empty, Boxes, Laboratory, RecreationCentre, Urban, Corridor, Gates, GatesOffset, Pillar])
def test_every_kind_takes_the_surroundings(kind: Any) -> None:
    surroundings = {
        "boxes": [{"center": [1000, 0, 0.5], "size": [1, 1, 1], "material": "brick"}],
        "cylinders": [{"center": [1010, 0, 0.5], "radius": 0.2, "height": 1}],
        "prisms": [{"outline": [[1020, 0], [1022, 0], [1020, 2]], "height": 3}],
        "movables": [{"name": "ball", "solid": BALL, "mass_kg": 1}],
        "moving": [{"name": "cart", "solid": CUBE, "times_s": [0, 1], "way": [[0, 0, 0.5, 0], [1, 0, 0.5, 0]]}],
        "floor_friction": 0.5,
        "zones": [{"center": [0, 0], "size": [2, 2], "friction": 0.1, "color": [200, 230, 255]}],
        "wind": {"velocity": [3, 0, 0], "gust": 1},
        "light": {"direction": [0, 0, 1], "ambient": 0.4},
    }
    world = binding.call(kind, surroundings).build()
    assert [type(solid) for solid in world.solids[-3:]] == [Box, Cylinder, Prism]
    assert (world.movables[0].name, world.moving[0].name, world.floor_friction) == ("ball", "cart", 0.5)
    assert (world.wind, world.light.ambient) == (Wind(velocity=(3.0, 0.0, 0.0), gust=1.0), 0.4)
    plain = binding.complete(kind, surroundings)
    assert binding.call(kind, plain).build() == world  # the resolved scenario gives an equal world
    picture = world.ground.image
    x, y = world.ground.center
    row = (y + 0.5 * world.ground.size[1] - 0.1) / world.ground.size[1] * len(picture)
    column = (0.1 - x + 0.5 * world.ground.size[0]) / world.ground.size[0] * picture.shape[1]
    assert picture[int(row), int(column)].tolist() == [200, 230, 255]  # the zone is in the picture


BOX = Box(center=(0.0, 0.0, 0.5), size=(1.0, 1.0, 1.0))
CRATE = Movable(name="a", solid=BOX, mass_kg=1.0)
CART = Moving(name="a", solid=BOX, times_s=(0.0,), way=((0.0, 0.0, 0.0, 0.0),))


@pytest.mark.parametrize(
    ("kind", "parameters", "key", "words"),
    [
        (Empty, {"movables": (CRATE,), "moving": (CART,)}, "", "two movables or moving obstacles are named 'a'"),
        (Empty, {"bounds": (1.0, 0.0, 0.0, 1.0)}, "bounds", "west < east and south < north"),
        (Laboratory, {"tile": 1e-6}, "tile", r"at least 0\.05 m"),
        (Urban, {"height_max": 3.0}, "height_max", "at least height_min"),
        (Urban, {"size": (40.0, 40.0)}, "size", "too small for one block"),
        (Urban, {"size": (1e9, 1e9), "block": 1e8}, "size", "at most 100000 m"),
        (Urban, {"lots": 12}, "gap", "leave less than 1 m"),
        (Urban, {"targets": (GroundTarget(size=11.0),)}, "targets", "number 0 finds no free place"),
        (Corridor, {"length": 16.0, "bends": (1.5,) * 4}, "bends", "crosses itself"),
        (Corridor, {"length": 16.0, "bends": (3.13,)}, "bends", "too short"),
        (Gates, {"number": 2, "offset": 0.4, "offsets": (0.0, 0.8)}, "offsets", "places all gaps already"),
        (GatesOffset, {"number": 2, "offset": 0.4, "offsets": (0.0, 0.8)}, "offsets", "places all gaps already"),
        (Gates, {"number": 3, "offsets": (0.0,)}, "offsets", r"one value per gate \(number = 3\), not 1"),
        (Gates, {"number": 3, "offsets": (0.0, 0.8, -0.5, 0.1)}, "offsets", r"one value per gate \(number = 3\), not 4"),
    ],
)
def test_impossible_worlds_are_refused(kind: Any, parameters: dict[str, Any], key: str, words: str) -> None:
    with pytest.raises(ScenarioError, match=words) as caught:
        kind(**parameters).build()
    assert caught.value.key == key


# --- laboratory ---------------------------------------------------------------------------------------------------------------


def test_the_laboratory_has_its_size_and_furniture() -> None:
    world = Laboratory().build()
    assert world.bounds == (-8.2, -4.75, 8.2, 4.75)
    assert len(world.solids) == 15 * 5 + 30 * 6 + 6
    points, _ = world.mesh()
    assert points[:, 2].max() == 2.6
    inner = [solid for solid in world.solids if isinstance(solid, Box) and solid.material != "brick"]
    assert all(abs(box.center[0]) + 0.5 * box.size[0] < 8.2 and abs(box.center[1]) + 0.5 * box.size[1] < 4.75 for box in inner)


def disc(x: float, y: float, radius: float) -> Array:
    angles = math.tau * np.arange(16) / 16
    return np.column_stack([x + radius * np.cos(angles), y + radius * np.sin(angles)])


def test_the_patrol_loop_and_the_aisles_are_free() -> None:
    world = Laboratory().build()
    loop = [*PATROL, PATROL[0]]
    ways = [(a, b, 0.55) for a, b in itertools.pairwise(loop)]
    ways += [((-7.5, y), (7.5, y), 0.5) for y in AISLES]
    for a, b, radius in ways:
        for share in np.linspace(0.0, 1.0, 100).tolist():
            x, y = a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])
            assert world.blocking(disc(x, y, radius), 0.0, 2.6) is None
    assert P2DX().radius_m < 0.5


def test_the_door_is_open_and_the_rest_of_the_walls_is_not() -> None:
    world = Laboratory().build()
    for x in np.arange(-8.0, 8.01, 0.1).tolist():
        assert (world.blocking(disc(x, -4.85, 0.05), 0.0, 2.0) is None) == (abs(x + 4.5) < 0.65)
        assert world.blocking(disc(x, 4.85, 0.05), 0.0, 2.0) is not None


# --- urban --------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("urban", [Urban(), Urban(size=(400.0, 250.0), block=50.0, street=14.0, lots=4, gap=2.0, seed=5)])
def test_streets_have_their_width_and_lots_are_apart(urban: Urban) -> None:
    world = urban.build()
    blocking = Blocking(world.shapes)
    pitch = urban.block + urban.street
    for axis in (0, 1):
        for middle in [*(each + 0.5 * pitch for each in urban.middles(axis)), urban.middles(axis)[0] - 0.5 * pitch]:
            x, y = (middle, 0.0) if axis == 0 else (0.0, middle)
            street = rectangle(x, y, 0.5 * urban.street - 1e-6, 1e3, 0.5 * math.pi * axis)
            assert blocking.deepest(street, 0.0, 1e3) is None
    ground = [box for box in world.solids if isinstance(box, Box) and box.center[2] == 0.5 * box.size[2]]
    for i, box in enumerate(ground):
        for other in ground[:i]:
            apart = [abs(box.center[k] - other.center[k]) - 0.5 * (box.size[k] + other.size[k]) for k in (0, 1)]
            assert max(apart) >= urban.gap - 1e-9


def test_heights_and_density() -> None:
    urban = Urban(size=(1000.0, 1000.0), density=0.7, height_min=5.0, height_max=30.0)
    world = urban.build()
    lots = len(urban.middles(0)) * len(urban.middles(1)) * 4
    tops: dict[tuple[int, int], float] = {}
    for box in world.solids:
        assert isinstance(box, Box)
        lot = math.floor((box.center[0] + 500.0) / 23.0), math.floor((box.center[1] + 500.0) / 23.0)
        tops[lot] = max(tops.get(lot, 0.0), box.center[2] + 0.5 * box.size[2])
    roofs = np.array(list(tops.values()))
    assert 5.0 <= roofs.min() < 5.5
    assert 29.5 < roofs.max() <= 30.0
    mean = 0.7 * lots
    bare = sum(isinstance(box, Box) and box.center[2] == 0.5 * box.size[2] for box in world.solids)
    assert abs(bare - mean) < 4.0 * math.sqrt(0.3 * mean)  # binomial, four standard deviations
    assert abs(roofs.mean() - 17.5) < 4.0 * 25.0 / math.sqrt(12.0 * bare) + 0.5  # uniform distribution


def test_another_seed_is_another_town_and_targets_move_no_house() -> None:
    assert Urban(seed=1).build().solids != Urban(seed=2).build().solids
    assert Urban(targets=(GroundTarget(),)).build().solids == Urban().build().solids


def test_targets_lie_on_streets_clear_of_each_other_and_can_be_found() -> None:
    urban = Urban(
        targets=(*[GroundTarget(size=3.0)] * 20, GroundTarget(name="flag", place=(1.0, 2.0), color=(0, 0, 255))), seed=4
    )
    world = urban.build()
    assert [each.name for each in world.targets] == [*(f"target{k + 1}" for k in range(20)), "flag"]
    places = [each.place(0.0) for each in world.targets]
    for place in places[:20]:
        assert world.blocking(disc(*place, 1.5), 0.0, 100.0) is None
        assert world.outside(*place) == 0.0
    assert all(math.dist(a, b) > 4.5 for i, a in enumerate(places[:20]) for b in places[:i])
    assert places[20] == (1.0, 2.0)


def test_the_lowest_buildings_are_solids() -> None:
    world = Urban(height_min=0.05, height_max=0.15).build()
    assert min(solid.size[2] for solid in world.solids if isinstance(solid, Box)) > 0.0
    assert list(overlaps(world)) == []


def test_two_thousand_buildings_fit_into_a_town() -> None:
    urban = Urban(size=(1200.0, 1200.0))
    on_the_ground = [box for box in urban.build().solids if isinstance(box, Box) and box.center[2] == 0.5 * box.size[2]]
    assert len(on_the_ground) >= 2000


def test_a_zone_without_colour_leaves_the_floor_as_it_is() -> None:
    zone = Zone(center=(0.0, 0.0), size=(1.0, 1.0), friction=0.1)
    assert Empty(zones=(zone,)).build().ground.image is None
    assert Empty(zones=(msgspec.structs.replace(zone, color=(1, 2, 3)),)).build().ground.image is not None


def test_a_town_without_a_seed_uses_the_run_seed() -> None:
    source = Source("test", Path())
    towns = {seed: worlds.build({"kind": "urban", "targets": [{}]}, source, seed=seed) for seed in (1, 2)}
    for seed, (world, resolved) in towns.items():
        assert world == Urban(seed=seed, targets=(GroundTarget(),)).build()
        assert "seed" not in resolved  # the resolved scenario contains the seed of the run
        assert worlds.build({"kind": "urban", "seed": 2}, source, seed=seed)[1]["seed"] == 2
    assert towns[1][0].solids != towns[2][0].solids
    assert towns[1][0].targets != towns[2][0].targets
    assert worlds.build({"kind": "recreation-centre"}, source, seed=5)[0] == RecreationCentre().build()


def test_a_run_its_drawing_and_its_radio_share_a_town(tmp_path: Path) -> None:
    """The recorded files give the same town again, with its pictures."""
    listed = [{"name": name, "picture": f"targets/{name}.png"} for name in ("alpha", "bravo")]
    scenario = {
        "name": "town",
        "duration_s": 0.1,
        "seed": 7,
        "physics": {"kind": "kinematic"},
        "world": {"kind": "urban", "targets": listed},
        "vehicle": [{"name": "uav", "kind": "point", "position": [0, 0, 40]}],
    }
    world = Urban(seed=7, targets=tuple(GroundTarget(name=each["name"]) for each in listed)).build()
    with assemble(*scenarios.load(scenario)) as assembled:
        assert assembled.world.solids == world.solids
        assert [each.place(0.0) for each in assembled.world.targets] == [each.place(0.0) for each in world.targets]
    vcmvsp.run(scenario, out=tmp_path / "run")
    assert {"alpha.png", "bravo.png"} <= {path.name for path in (tmp_path / "run").iterdir()}
    run_world, _ = worlds.world_of(str(tmp_path / "run" / "scenario.toml"), {})
    assert run_world.solids == world.solids
    assert [each.picture for each in run_world.targets] == [str(tmp_path / "run" / f"{each['name']}.png") for each in listed]
    assert len({worlds.world_of(str(tmp_path / "run" / "scenario.toml"), {"seed": k})[0].solids for k in range(4)}) == 4


@pytest.mark.parametrize("bends", [(), (0.5,), (2.0,), (0.7, -1.2, 1.57), (-1.0, -1.0)])
def test_a_corridor_has_its_width_everywhere(bends: tuple[float, ...]) -> None:
    corridor = Corridor(length=30.0, width=2.0, bends=bends)
    world, middle = corridor.build(), corridor.middle()
    assert np.hypot(*np.diff(middle, axis=0).T).sum() == pytest.approx(30.0)
    for a, b in itertools.pairwise(middle):
        for share in np.linspace(0.0, 1.0, 40).tolist():
            x, y = a + share * (b - a)
            assert world.blocking(disc(x, y, 0.999), 0.0, 2.0) is None
        assert world.blocking(disc(0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 1.05), 0.0, 2.0) is not None


def test_a_closed_corridor_ends() -> None:
    assert Corridor(closed=True).build().blocking(disc(20.1, 0.0, 0.05), 0.0, 1.0) is not None
    assert Corridor().build().blocking(disc(20.1, 0.0, 0.05), 0.0, 1.0) is None


@pytest.mark.parametrize("bends", [(), (0.7, -1.2)])
def test_a_corridor_may_begin_anywhere_on_its_axis(bends: tuple[float, ...]) -> None:
    plain, moved = Corridor(bends=bends, closed=True), Corridor(bends=bends, closed=True, start=-2.5)
    assert moved.middle() == pytest.approx(plain.middle() - (2.5, 0.0))
    for one, other in zip(plain.build().shapes.groups, moved.build().shapes.groups, strict=True):
        assert other.corners == pytest.approx(one.corners - (2.5, 0.0))


def test_gates_are_open_at_their_gaps() -> None:
    for gates, offset in ((Gates(number=3), 0.0), (GatesOffset(number=3), 0.75)):
        world = gates.build()
        for gate in range(3):
            y = offset * (-1.0) ** gate
            assert world.blocking(disc(4.0 * (gate + 1), y, 0.74), 0.0, 0.5) is None
            for side in (-0.76, 0.76, 2.7, -2.7):
                assert world.blocking(disc(4.0 * (gate + 1), y + side, 0.05), 0.0, 0.5) is not None


@pytest.mark.parametrize("kind", [Gates, GatesOffset])
def test_gates_have_own_offsets(kind: type[Gates]) -> None:
    """Gaps of 0.9 m every 3.5 m; ``offset`` is ignored here."""
    offsets = (0.0, 0.8, -0.5)
    world = kind(number=3, spacing=3.5, width=0.9, offsets=offsets).build()
    assert world.name == "gates-offset"
    for gate, y in enumerate(offsets):
        x = 3.5 * (gate + 1)
        assert world.blocking(disc(x, y, 0.449), 0.0, 0.5) is None
        for side in (-0.46, 0.46, 2.4, -2.4):
            assert world.blocking(disc(x, y + side, 0.02), 0.0, 0.5) is not None
    same = Gates(number=2, offsets=(0.75, -0.75)).build()
    assert same.solids == GatesOffset(number=2).build().solids
    assert Gates(number=2, offsets=(0.0, 0.0)).build().name == "gates"


def test_a_pillar_stands_in_place() -> None:
    world = Pillar(position=(3.0, 1.0), radius=0.5).build()
    solid, depth = world.blocking(disc(3.0, 0.3, 0.3), 0.0, 0.5) or (None, 0.0)
    assert isinstance(solid, Cylinder)
    assert depth == pytest.approx(0.1, abs=0.02)  # 0.7 m apart, radii 0.5 and 0.3
    assert world.blocking(disc(3.0, 0.3, 0.19), 0.0, 0.5) is None


def test_a_square_pillar_has_corners() -> None:
    """Its edge is twice the radius: 5 cm from its side, and outside the circle at its corner."""
    world = Pillar(position=(3.0, 1.0), radius=0.25, square=True).build()
    assert world.solids == (Box(center=(3.0, 1.0, 1.5), size=(0.5, 0.5, 3.0)),)
    assert world.blocking(disc(3.0, 0.5, 0.2), 0.0, 0.5) is None
    assert world.blocking(disc(3.24, 1.24, 0.005), 0.0, 0.5) is not None
    assert Pillar(position=(3.0, 1.0), radius=0.25).build().blocking(disc(3.24, 1.24, 0.005), 0.0, 0.5) is None
