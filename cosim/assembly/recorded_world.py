"""The world of a recorded run: rebuilt if its kind is built in, else read from the recording's drawing."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.recording.foxglove import Color, FrameTransforms, Quaternion, SceneEntity, SceneUpdate
from vcmvsp.cosim.recording.mcap_reader import of_topic
from vcmvsp.cosim.recording.recorded_run import FILE
from vcmvsp.cosim.recording.run_mcap import MOVING, SCENE, SOLIDS
from vcmvsp.cosim.recording.scene import OBSTACLE, TARGET_ID
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.physics.world.floor import PlacedTarget
from vcmvsp.physics.world.solids import Box, Cylinder, Mesh
from vcmvsp.physics.world.world import Movable, World

T = TypeVar("T")


def world_in(folder: Path, scenario: Scenario, source: Source) -> World:
    """The world of the run in a folder; `registry.may_import` decides whether its class may be imported.

    Raises:
        ScenarioError: a world of a built-in kind can no longer be built.
        UsageError: the recording cannot be read.
    """
    if registry.may_import("world", scenario.world.get("kind", "empty")):
        return worlds.build(scenario.world, source, seed=scenario.seed)[0]
    try:
        return world_of_drawing(folder / FILE)
    except (OSError, ValueError, IndexError) as error:
        raise UsageError(f"{folder / FILE}: cannot read the world: {error}") from error


def world_of_drawing(recording: Path) -> World:
    """The world as a recording draws it: meshes without material, obstacles at their start, targets.

    Raises:
        OSError, ValueError: the recording cannot be read.
        IndexError: an entity of the drawing lacks its shape.
    """
    drawing = next(_read(recording, SOLIDS, SceneUpdate), (0, SceneUpdate([])))[1]
    standing = [_mesh(each) for each in drawing.entities if not each.id.startswith(OBSTACLE)]
    moving = [each for each in drawing.entities if each.id.startswith(OBSTACLE)]
    frames = next(_read(recording, MOVING, FrameTransforms), (0, FrameTransforms([])))[1] if moving else FrameTransforms([])
    places = {each.child_frame_id: each for each in frames.transforms}
    obstacles = []
    for each in moving:
        if each.id in places:
            at, turn = places[each.id].translation, places[each.id].rotation
            obstacles.append(_obstacle(each, (at.x, at.y, at.z), _yaw(turn)))
    solids = tuple(mesh for meshes in standing for mesh in meshes)
    return World(solids=solids, movables=tuple(obstacles), targets=_targets(recording))


@dataclass(frozen=True, kw_only=True)
class RecordedTarget(PlacedTarget):
    """A target at its recorded positions, once a second, linearly interpolated.

    Args:
        times_s: times of the recorded positions.
    """

    times_s: tuple[float, ...]

    def place(self, time_s: float) -> tuple[float, float]:
        """Position of its centre at a time, x, y, m."""
        x, y = (float(np.interp(time_s, self.times_s, column)) for column in zip(*self.way, strict=True))
        return x, y


def _read(recording: Path, topic: str, kind: type[T]) -> Iterator[tuple[int, T]]:
    """Time (ns) and content of the messages of a topic."""
    with recording.open("rb") as stream:
        for time_ns, data in of_topic(stream, topic):
            yield time_ns, read_json(data, kind, limit=limits.DRAWING_BYTES)


def _mesh(entity: SceneEntity) -> list[Mesh]:
    meshes = []
    for part in entity.triangles:
        points = np.array([(each.x, each.y, each.z) for each in part.points]).reshape(-1, 3)
        meshes.append(Mesh(triangles=points[np.array(part.indices, np.int64).reshape(-1, 3)], color=_rgb(part.color)))
    return meshes


def _obstacle(entity: SceneEntity, center: tuple[float, float, float], yaw: float) -> Movable:
    name = entity.id.removeprefix(OBSTACLE)
    if entity.cubes:
        size, color = entity.cubes[0].size, _rgb(entity.cubes[0].color)
        box = Box(center=center, size=(size.x, size.y, size.z), yaw_rad=yaw, color=color)
        return Movable(name=name, solid=box, mass_kg=1.0)
    size, color = entity.cylinders[0].size, _rgb(entity.cylinders[0].color)
    return Movable(name=name, solid=Cylinder(center=center, radius=0.5 * size.x, height=size.z, color=color), mass_kg=1.0)


def _targets(recording: Path) -> tuple[PlacedTarget, ...]:
    history: dict[str, list[tuple[float, SceneEntity]]] = {}
    for time_ns, scene in _read(recording, SCENE, SceneUpdate):
        target_entities = [each for each in scene.entities if each.id.startswith(TARGET_ID)]
        if not target_entities:  # no later frame will have one
            break
        for each in target_entities:
            history.setdefault(each.id.removeprefix(TARGET_ID), []).append((time_ns / SECOND_NS, each))
    targets = []
    for name, entities in history.items():
        sheets = [entity.cubes[0] for _, entity in entities]
        way = tuple((each.pose.position.x, each.pose.position.y) for each in sheets)
        targets.append(
            RecordedTarget(
                name=name,
                size_m=sheets[0].size.x,
                picture="",
                color=_rgb(sheets[0].color),
                yaw_rad=_yaw(sheets[0].pose.orientation),
                way=way,
                times_s=tuple(time_s for time_s, _ in entities),
            )
        )
    return tuple(targets)


def _yaw(turn: Quaternion) -> float:
    return yaw_of((turn.w, turn.x, turn.y, turn.z))


def _rgb(color: Color) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in (color.r, color.g, color.b))
    return red, green, blue
