"""Constant data for the control station, for a run or a recording: vehicles and their surroundings."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.assembly import recorded_world, worlds
from vcmvsp.cosim.assembly.parts.vehicles import Vehicle, flies
from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.config.registry import NO_CODE, only
from vcmvsp.cosim.recording.foxglove import SceneUpdate
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.scenario.schema import Scenario, VehicleTable
from vcmvsp.cosim.types import frozen
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.view.messages import Craft, Floor, Lens, Obstacle, Scenery, ShapePart

RECORDED = ("pace", "seek", "sensors")
"""Orders that a recording executes."""
WIDEST_PX = 2048  # of the picture on the floor
DEFAULT_WIDTH_M = 0.5  # of a vehicle not drawn in the recording
VehicleKinds = dict[str, type[Vehicle]]  # by their names in the scenario
Shapes = dict[str, tuple[ShapePart, ...]]  # by file


def scenery_of(
    scenario: Scenario,
    source: Source,
    *,
    world: "worlds.World | None" = None,
    live: bool = False,
    may: Sequence[str] = (),
    keys: Mapping[str, float] | None = None,
    drawn: Mapping[str, Craft] | None = None,
) -> Scenery:
    """Scenery of a scenario. Builds no agent, radio or engine.

    Args:
        scenario: scenario of the run or of the recording.
        source: origin of the scenario.
        world: the world of the run, if it has been built already.
        live: whether the run is current.
        may: tags of the allowed orders.
        keys: scenario keys that may change at run time, and their values.
        drawn: vehicles as drawn in the recording, for vehicles whose classes may not be imported (`registry.may_import`).

    Raises:
        ScenarioError: the world, or a kind of vehicle, cannot be built.
    """
    if world is None:
        world, _ = worlds.build(scenario.world, source, seed=scenario.seed)
    vertices, triangles = world.mesh()
    shapes: Shapes = {}
    vehicles = crafts_of(scenario, source, drawn=drawn, shapes=shapes)
    return Scenery(
        scenario=scenario.name,
        seed=scenario.seed,
        duration_ns=seconds_to_ns(scenario.duration_s),
        vehicles=vehicles,
        shapes=shapes,
        vertices=frozen(vertices, np.float32),
        triangles=frozen(triangles, np.uint32),
        colors=frozen(world.mesh_colors()),
        obstacles=_obstacles(world, "move" in may),
        targets=tuple((each.name, *each.place(0.0)) for each in world.targets),
        bounds=world.bounds,
        floor=_floor(world),
        live=live,
        may=tuple(may),
        keys=dict(keys or {}),
        site=_site(scenario),
    )


def _site(scenario: Scenario) -> str:
    """What traces the rays of a scenario: world, radio, heights of antennas; empty: its radio has no rays."""
    path_loss = scenario.first_radio.get("path_loss")
    if scenario.radios or not isinstance(path_loss, Mapping) or path_loss.get("kind") != "rays":
        return ""
    vehicles = []
    for each in scenario.vehicle:
        height_m = each.radio.get("antenna_height_m")
        radio = {} if height_m is None else {"antenna_height_m": height_m}
        vehicles.append({"name": each.name, "kind": "kinematic", "radio": radio})
    content = {
        "name": scenario.name,
        "duration_s": scenario.duration_s,
        "seed": scenario.seed,
        "world": scenario.world,
        "radio": scenario.radio,
        "vehicle": vehicles,
    }
    return msgspec.json.encode(binding.plain(content)).decode()


def crafts_of(
    scenario: Scenario,
    source: Source,
    *,
    infos: Sequence[AgentInfo] = (),
    drawn: Mapping[str, Craft] | None = None,
    shapes: Shapes | None = None,
) -> tuple[Craft, ...]:
    """The vehicles of a scenario.

    Args:
        infos: properties that agents reported; default: those in the scenario.
        scenario, source, drawn: as of `scenery_of`.
        shapes: receives the shapes of vehicles that have their own.

    Raises:
        ScenarioError: a kind of vehicle cannot be built.
    """
    agents = {info.vehicle: info for info in infos}
    kinds: VehicleKinds = {}  # cached: a user's file is executed once, not once per vehicle
    all_shapes: Shapes = {} if shapes is None else shapes
    return tuple(
        _craft(each, scenario, source, agents.get(each.name), kinds, drawn or {}, all_shapes) for each in scenario.vehicle
    )


def _craft(
    vehicle: VehicleTable,
    scenario: Scenario,
    source: Source,
    info: AgentInfo | None,
    kinds: VehicleKinds,
    drawn: Mapping[str, Craft],
    shapes: Shapes,
) -> Craft:
    agent, period_s = _agent(vehicle, scenario, info)
    if vehicle.name in drawn and not registry.may_import("vehicle", vehicle.kind):
        body = drawn[vehicle.name]
    else:
        model = _model(vehicle, source, kinds)
        body = Craft(name=vehicle.name, kind="", size=model.hull.size, offset=model.hull.offset, flies=flies(model))
        body = msgspec.structs.replace(body, shape=_shape(model, shapes))
    return msgspec.structs.replace(
        body,
        kind=vehicle.kind,
        real=vehicle.is_real,
        agent=agent,
        period_s=period_s,
        sensors={name: str(content.get("kind", "")) for name, content in vehicle.sensors.items()},
        cameras=_lenses(vehicle, source),
    )


def _shape(model: Any, shapes: Shapes) -> str:
    """Name of a model's own shape, which is added to ``shapes``; empty: it has none."""
    if not getattr(model, "drawn", ()):
        return ""
    if model.file not in shapes:
        parts = [ShapePart(triangles=frozen(each.triangles, np.float32), color=each.color) for each in model.drawn]
        shapes[model.file] = tuple(parts)
    return str(model.file)


def _lenses(vehicle: VehicleTable, source: Source) -> dict[str, Lens]:
    """The views of a vehicle's cameras, as far as their classes may be imported."""
    lenses = {}
    for name, content in vehicle.sensors.items():
        kind, key = content.get("kind"), f"vehicle.{vehicle.name}.sensors.{name}"
        if not isinstance(kind, str) or not registry.may_import("sensor", kind):
            continue
        maker = registry.find("sensor", kind, folder=source.folder, key=f"{key}.kind", origin=source)
        if hasattr(maker, "body_from_camera"):
            camera, _ = registry.build("sensor", content, key=key, source=source)
            first, second, third = ((x, y, z) for x, y, z in camera.body_from_camera.tolist())
            lenses[name] = Lens(
                mount=camera.mount,
                body_from_camera=(first, second, third),
                field_of_view=2.0 * math.atan(0.5 * camera.height / camera.focal_px),
                aspect=camera.width / camera.height,
            )
    return lenses


def _model(vehicle: VehicleTable, source: Source, kinds: VehicleKinds) -> Vehicle:
    """Build the vehicle model; unknown parameters are ignored, because the run has rejected them."""
    key = f"vehicle.{vehicle.name}"
    if vehicle.kind not in kinds:
        kinds[vehicle.kind] = registry.find("vehicle", vehicle.kind, folder=source.folder, key=f"{key}.kind", origin=source)
    kind = kinds[vehicle.kind]
    params = {name: value for name, value in vehicle.params.items() if name in binding.parameters(kind)}
    return binding.call(kind, registry.with_real_paths(kind, params, source, key), key=key, origin=source)


def _agent(vehicle: VehicleTable, scenario: Scenario, info: AgentInfo | None) -> tuple[str, float | None]:
    """Kind of a vehicle's agent, empty without one, and its period, s, if known."""
    if info is not None:
        return info.agent, float(info.ticks.period) / SECOND_NS
    if vehicle.agent is None:
        return "", None
    kind = vehicle.agent.kind or str(scenario.agents.defaults.get("kind", ""))
    return kind, vehicle.agent.period_s or scenario.agents.period_s


def _floor(world: "worlds.World") -> Floor | None:
    """The picture on the floor of a world, at most `WIDEST_PX` along an edge; None: the floor has one colour."""
    ground = world.ground
    if ground.image is None:
        return None
    import cv2

    pixels = ground.image
    height, width = pixels.shape[:2]
    if max(height, width) > WIDEST_PX:
        share = WIDEST_PX / max(height, width)
        less = max(1, round(width * share)), max(1, round(height * share))
        pixels = cv2.resize(pixels, less, interpolation=cv2.INTER_AREA)
    return Floor(pixels=frozen(pixels, np.uint8), center=ground.center, size=ground.size)


def _obstacles(world: "worlds.World", may_be_moved: bool) -> tuple[Obstacle, ...]:
    """Pushable bodies, which the user may move if allowed, and obstacles with a time-table."""
    obstacles = []
    for bodies, movable in ((world.movables, may_be_moved), (world.moving, False)):
        for each in bodies:
            size, _, kind, color = each.solid.hull
            obstacle = Obstacle(name=each.name, shape=kind, size=size, pose=each.pose(0.0), color=color, may_be_moved=movable)
            obstacles.append(obstacle)
    return tuple(obstacles)


def recorded_stage(
    path: Path, vehicles: Sequence[str], drawing: bytes | None, *, trust: bool = False
) -> tuple[Scenery, "worlds.World"]:
    """Scenery and world of a run's resolved scenario; classes that are not built in are replaced by the recording's drawing.

    Raises:
        ScenarioError, UsageError: scenery or world can no longer be built.
        ValueError: its vehicles differ from those of the recording.
    """
    scenario, source = scenarios.load(path)
    if tuple(each.name for each in scenario.vehicle) != tuple(vehicles):
        raise ValueError(f"{path} does not belong to the recording beside it")
    with only(None if trust else NO_CODE):
        world = recorded_world.world_in(path.parent, scenario, source)
        return scenery_of(scenario, source, world=world, may=RECORDED, drawn=_craft_of(vehicles, drawing)), world


def bare_scenery(about: Mapping[str, str], vehicles: Sequence[str], drawing: bytes | None) -> Scenery:
    """Scenery with the vehicles alone, in the sizes drawn in the recording.

    Raises:
        ValueError: the drawing is no valid message.
    """
    seed = about.get("seed", "")
    return Scenery(
        scenario=about.get("scenario", ""),
        seed=int(seed) if seed.isdecimal() else 0,
        duration_ns=0,
        vehicles=tuple(_craft_of(vehicles, drawing).values()),
        vertices=frozen(np.zeros((0, 3)), np.float32),
        triangles=frozen(np.zeros((0, 3)), np.uint32),
        colors=frozen(np.zeros((0, 3)), np.uint8),
        may=RECORDED,
    )


def _craft_of(vehicles: Sequence[str], drawing: bytes | None) -> dict[str, Craft]:
    entities = () if drawing is None else read_json(drawing, SceneUpdate).entities
    width_m = {each.id: each.cylinders[0].size.x for each in entities if each.cylinders}
    sizes = {name: width_m.get(name, DEFAULT_WIDTH_M) for name in vehicles}
    return {name: Craft(name=name, kind="", size=(size, size, 0.5 * size)) for name, size in sizes.items()}
