"""Scenery of the control station: the vehicles of a scenario and their surroundings."""

import math
from typing import Any

import numpy as np
import pytest

from tests.support.paths import ROOT
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.messages import Scenery
from vcmvsp.cosim.view.scenery import crafts_of, scenery_of

SOLIDS: list[dict[str, Any]] = [
    {"kind": "box", "center": [0.0, 0.0, 0.5], "size": [1.0, 1.0, 1.0], "color": [1, 0, 0]},
    {"kind": "cylinder", "center": [10.0, 0.0, 0.5], "radius": 0.5, "height": 1.0, "color": [2, 0, 0]},
    {"kind": "box", "center": [20.0, 0.0, 0.5], "size": [1.0, 1.0, 1.0], "yaw_rad": 0.5, "material": "brick"},
]
THINGS: dict[str, Any] = {
    "movables": [
        {
            "name": "crate",
            "solid": {"kind": "box", "center": [0, 5, 0.2], "size": [0.4, 0.6, 0.4], "yaw_rad": 0.3},
            "mass_kg": 1.0,
        }
    ],
    "moving": [
        {
            "name": "guard",
            "solid": {"kind": "cylinder", "center": [0, 0, 0], "radius": 0.3, "height": 1.8},
            "times_s": [0.0, 10.0],
            "way": [[3, 3, 0.9, 0.1], [4, 3, 0.9, 0.1]],
        }
    ],
    "targets": [{"name": "alpha", "place": [7.0, 8.0]}],
}
CONTENT: dict[str, Any] = {
    "name": "small",
    "duration_s": 1.0,
    "seed": 3,
    "agents": {"kind": "patrol", "period_s": 0.2},
    "vehicle": [
        {
            "name": "car",
            "kind": "p2dx",
            "pose": [0, -5, 0],
            "agent": {"waypoints": [[0, -6]]},
            "sensors": {"scan": {"kind": "lms"}},
        },
        {"name": "uav", "kind": "quadrotor", "position": [0, -9, 2]},
    ],
}


def small(world: dict[str, Any] | None = None, **more: Any) -> Scenery:
    """The scenery of a world with two vehicles."""
    return scenery_of(*scenarios.load({**CONTENT, "world": world or {"kind": "empty"}}), **more)


def test_each_triangle_has_the_colour_of_its_solid() -> None:
    scenery = small({"kind": "boxes", "boxes": [SOLIDS[0], SOLIDS[2]], "cylinders": [SOLIDS[1]]})
    corners = scenery.vertices[scenery.triangles]
    assert len(corners) == len(scenery.colors) > 24
    for triangle, color in zip(corners, scenery.colors, strict=True):
        solid = SOLIDS[round(float(triangle[:, 0].mean()) / 10.0)]
        assert color.tolist() == solid.get("color", [164, 84, 66])


@pytest.mark.parametrize("name", scenarios.names())
def test_every_scenario_can_be_shown_and_sent(name: str) -> None:
    parsed, source = scenarios.load(name)
    scenery = scenery_of(parsed, source)
    assert [craft.name for craft in scenery.vehicles] == [vehicle.name for vehicle in parsed.vehicle]
    assert scenery.triangles.shape == scenery.colors.shape
    if len(scenery.triangles):
        assert scenery.triangles.max() < len(scenery.vertices)
    start = protocol.starts.decode(codec.encode(protocol.Start(scenery=scenery, host="h", port=1, token="t")))
    assert start.scenery.vehicles == scenery.vehicles
    assert np.array_equal(start.scenery.vertices, scenery.vertices)


def test_obstacles_and_targets_have_their_start_positions() -> None:
    scenery = small({"kind": "empty", **THINGS}, may=("move",))
    crate, guard = scenery.obstacles
    assert (crate.name, crate.shape, crate.size, crate.pose) == ("crate", "box", (0.4, 0.6, 0.4), (0.0, 5.0, 0.2, 0.3))
    assert (guard.name, guard.shape, guard.size, guard.pose) == ("guard", "cylinder", (0.6, 0.6, 1.8), (3.0, 3.0, 0.9, 0.1))
    assert (crate.may_be_moved, guard.may_be_moved) == (True, False)
    assert scenery.targets == (("alpha", 7.0, 8.0),)
    assert not small({"kind": "empty", **THINGS}).obstacles[0].may_be_moved


def test_information_of_agents_wins_over_the_scenario() -> None:
    car, uav = small().vehicles
    assert (car.agent, car.period_s, car.flies, car.sensors) == ("patrol", 0.2, False, {"scan": "lms"})
    assert (uav.agent, uav.period_s, uav.flies, uav.sensors) == ("", None, True, {})
    parsed, source = scenarios.load("lab-patrol")  # its agents have their own periods
    with assemble(parsed, source) as assembled:
        crafts = crafts_of(parsed, source, infos=assembled.agents)
    assert scenery_of(parsed, source).vehicles[0].period_s is None
    assert crafts[0].period_s == 0.1


def test_views_of_cameras_equal_their_sensors() -> None:
    camera = {"kind": "nadir_camera", "width": 200, "height": 100, "field_of_view": 1.0, "mount": [0.1, 0.2, 0.3]}
    flying = {"name": "uav", "kind": "quadrotor", "position": [0, -9, 2], "sensors": {"eye": camera, "scan": {"kind": "ring"}}}
    (uav,) = scenery_of(*scenarios.load({**CONTENT, "vehicle": [flying]})).vehicles
    assert [*uav.cameras] == ["eye"]
    eye = uav.cameras["eye"]
    assert (eye.mount, eye.aspect) == ((0.1, 0.2, 0.3), 2.0)
    assert math.tan(0.5 * eye.field_of_view) == pytest.approx(0.5 * math.tan(0.5))  # half as high as wide
    right, down, axis = np.asarray(eye.body_from_camera).T
    assert axis == pytest.approx((0.0, 0.0, -1.0), abs=1e-12)
    assert (*right, *down) == pytest.approx((0.0, -1.0, 0.0, -1.0, 0.0, 0.0), abs=1e-12)


def test_vehicles_of_one_urdf_file_share_its_shape() -> None:
    keys = {"file": str(ROOT / "examples" / "cart.urdf"), "left_wheel": "left_wheel", "right_wheel": "right_wheel"}
    carts = [{"name": f"cart{k}", "kind": "urdf", "pose": [0, k, 0], **keys} for k in range(2)]
    scenery = scenery_of(*scenarios.load({**CONTENT, "vehicle": [*carts, CONTENT["vehicle"][0]]}))
    assert [craft.shape for craft in scenery.vehicles] == [keys["file"], keys["file"], ""]
    ((part,),) = scenery.shapes.values()
    assert len(part.triangles) > 100


def test_the_floor_is_the_picture_that_cameras_see() -> None:
    green, grey = (10, 200, 10), (90, 90, 90)
    marks = [{"outline": [[0, 0], [10, 0], [10, 5], [0, 5]], "color": list(green)}]
    ground = {"center": [0.0, 0.0], "size": [20.0, 10.0], "color": list(grey), "marks": marks}
    floor = small({"kind": "boxes", "boxes": [], "ground": ground}).floor
    assert floor is not None
    height, width = floor.pixels.shape[:2]
    north_east, south_west = floor.pixels[height // 4, 3 * width // 4], floor.pixels[3 * height // 4, width // 4]
    assert (north_east.tolist(), south_west.tolist()) == (list(green), list(grey))
    assert (floor.center, floor.size) == ((0.0, 0.0), (20.0, 10.0))
    assert small().floor is None
