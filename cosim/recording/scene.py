"""Drawing of a run for 3D viewers: body, heading and name of each vehicle, slots of followers, targets.

Static bodies are drawn once (`solids`), obstacles with a time-table in their own frames (`moving_frames`). Pushable bodies are
not drawn: a recording does not contain their poses.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.frames import quaternion_from_yaw
from vcmvsp.cosim.metrics.mission import Target
from vcmvsp.cosim.recording import foxglove as fg
from vcmvsp.cosim.types import Array, Follows, Pushed, Vec3
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.palette import TARGET, rgb, rgb_of

TARGET_HEIGHT_M = 0.05
DEFAULT_RADIUS_M = 0.25  # of a vehicle whose radius is unknown
MOST_TRIANGLES = limits.TRIANGLES  # limit for drawing a world; more are some 30 MB of JSON before compression
DIGITS = 4  # of coordinates, m: a tenth of a millimetre
OBSTACLE_OPACITY = 0.9
OBSTACLE, TARGET_ID = "obstacle/", "target/"  # prefixes of entity names
_RING = [(math.cos(i * math.tau / 24), math.sin(i * math.tau / 24)) for i in range(24)]


class DrawnSolid(Protocol):
    """Shape of an obstacle."""

    @property
    def hull(self) -> tuple[Vec3, Vec3, str, tuple[int, int, int]]:
        """Size and offset, m, "box" or "cylinder", and colour."""


class DrawnObstacle(Protocol):
    """A movable obstacle: `physics.world.world.Movable` or `Moving`."""

    @property
    def name(self) -> str:
        """Unique name in the world."""

    @property
    def solid(self) -> DrawnSolid:
        """Shape of the obstacle."""

    def pose(self, time_s: float) -> tuple[float, float, float, float]:
        """Centre, m, and yaw, rad, unless it was pushed."""


class DrawnWorld(Protocol):
    """Solids and obstacles of a run: `physics.world.world.World`."""

    @property
    def movables(self) -> Sequence[DrawnObstacle]:
        """Bodies that can be pushed."""

    @property
    def moving(self) -> Sequence[DrawnObstacle]:
        """Obstacles with a time-table."""

    @property
    def targets(self) -> Sequence[Target]:
        """Search targets: flat pictures on the floor."""

    def mesh(self) -> tuple[Array, Array]:
        """Vertices (v, 3) m and triangles (t, 3) of all solids."""

    def mesh_colors(self) -> Array:
        """Colours (t, 3) uint8 of the triangles."""

    def least_clearance_m(self, time_ns: Array, position: Array) -> float | None:
        """Smallest distance (m) of any place (3, m, n) m to an obstacle at the m instants."""


def scene(
    vehicles: Sequence[str],
    radius_m: Mapping[str, float],
    places: Mapping[str, Follows],
    time_ns: int,
    targets: Sequence[Target] = (),
) -> fg.SceneUpdate:
    """The complete scene: entities move with their vehicles' frames and stay until the next scene replaces them."""
    now, entities = fg.Time.of(time_ns), []
    for index, name in enumerate(vehicles):
        color, radius = fg.Color(*rgb_of(index)), radius_m.get(name, DEFAULT_RADIUS_M)
        entities.append(_body(name, radius, color, now))
        if name in places and places[name].leader is not None:
            entities.append(_place(name, places[name], radius, color, now))
    entities += [_target(target, now, time_ns / SECOND_NS) for target in targets]
    return fg.SceneUpdate(entities, [fg.SceneEntityDeletion(now)])


def solids(world: DrawnWorld) -> fg.SceneUpdate | None:
    """A world's solids by colour and its obstacles with a time-table; None if empty or larger than `MOST_TRIANGLES`."""
    vertices, triangles = world.mesh()
    if len(triangles) > MOST_TRIANGLES:
        return None
    now, entities = fg.Time(0, 0), []
    if len(triangles):
        parts = _by_color(np.round(vertices, DIGITS), triangles, world.mesh_colors())
        entities.append(fg.SceneEntity(now, "world", "solids", fg.Duration(), False, triangles=parts))
    entities += [_obstacle(each, now) for each in (*world.movables, *world.moving)]
    return fg.SceneUpdate(entities) if entities else None


def moving_frames(world: DrawnWorld, pushed: Pushed | None, time_ns: int) -> fg.FrameTransforms:
    """Poses of movable obstacles: with a time-table or pushable."""
    placed: list[tuple[str, Sequence[float], Sequence[float]]] = []
    for each in (*world.moving, *(world.movables if pushed is None else ())):
        x, y, z, yaw = each.pose(time_ns / SECOND_NS)
        placed.append((each.name, (x, y, z), quaternion_from_yaw(yaw)))
    if pushed is not None:
        placed += zip(pushed.names, pushed.position.tolist(), pushed.attitude.tolist(), strict=True)
    now, transforms = fg.Time.of(time_ns), []
    for name, place, (qw, qx, qy, qz) in placed:
        transforms.append(fg.FrameTransform(now, "world", _frame_of(name), fg.Vector3(*place), fg.Quaternion(qx, qy, qz, qw)))
    return fg.FrameTransforms(transforms)


def _frame_of(name: str) -> str:
    return f"{OBSTACLE}{name}"


def _by_color(vertices: Array, triangles: Array, colors: Array) -> list[fg.TriangleListPrimitive]:
    palette, color_index = np.unique(colors, axis=0, return_inverse=True)
    parts = []
    for number, (red, green, blue) in enumerate(palette.tolist()):
        used, indices = np.unique(triangles[color_index.ravel() == number], return_inverse=True)
        points = [fg.Vector3(*point) for point in vertices[used].tolist()]
        color = fg.Color(red / 255, green / 255, blue / 255)
        parts.append(fg.TriangleListPrimitive(fg.Pose(), points, color, indices.ravel().tolist()))
    return parts


def _obstacle(moving: DrawnObstacle, now: fg.Time) -> fg.SceneEntity:
    (length, width, height), _, kind, rgb_color = moving.solid.hull
    red, green, blue = (part / 255 for part in rgb_color)
    color, size, frame = fg.Color(red, green, blue, OBSTACLE_OPACITY), fg.Vector3(length, width, height), _frame_of(moving.name)
    text = fg.TextPrimitive(fg.Pose(fg.Vector3(0.0, 0.0, height)), True, 14.0, True, color, moving.name)
    cubes = [fg.CubePrimitive(fg.Pose(), size, color)] if kind == "box" else []
    cylinders = [] if cubes else [fg.CylinderPrimitive(fg.Pose(), size, 1.0, 1.0, color)]
    return fg.SceneEntity(now, frame, frame, fg.Duration(), True, cubes=cubes, cylinders=cylinders, texts=[text])


def _body(name: str, radius: float, color: fg.Color, now: fg.Time) -> fg.SceneEntity:
    cylinder = fg.CylinderPrimitive(
        fg.Pose(), fg.Vector3(2 * radius, 2 * radius, radius), 1.0, 1.0, fg.Color(color.r, color.g, color.b, 0.8)
    )
    ahead = fg.Pose(fg.Vector3(0.0, 0.0, 0.5 * radius))
    arrow = fg.ArrowPrimitive(ahead, 1.2 * radius, 0.2 * radius, 0.5 * radius, 0.5 * radius, color)
    text = fg.TextPrimitive(fg.Pose(fg.Vector3(0.0, 0.0, 1.6 * radius)), True, 14.0, True, color, name)
    return fg.SceneEntity(now, name, name, fg.Duration(), True, arrows=[arrow], cylinders=[cylinder], texts=[text])


def _place(name: str, follows: Follows, radius: float, color: fg.Color, now: fg.Time) -> fg.SceneEntity:
    x, y = follows.slot
    line = fg.LinePrimitive(0, fg.Pose(), 1.5, True, [fg.Vector3(), fg.Vector3(x, y)], color)
    ring = [fg.Vector3(x + radius * c, y + radius * s) for c, s in _RING]
    outline = fg.LinePrimitive(1, fg.Pose(), 1.5, True, ring, color)
    return fg.SceneEntity(now, str(follows.leader), f"{name}/place", fg.Duration(), True, lines=[line, outline])


def _target(target: Target, now: fg.Time, time_s: float) -> fg.SceneEntity:
    (x, y), half = target.place(time_s), 0.5 * target.yaw(time_s)
    pose = fg.Pose(fg.Vector3(x, y), fg.Quaternion(z=math.sin(half), w=math.cos(half)))
    color = fg.Color(*rgb(TARGET), 0.6)
    sheet = fg.CubePrimitive(pose, fg.Vector3(target.size_m, target.size_m, TARGET_HEIGHT_M), color)
    text = fg.TextPrimitive(fg.Pose(fg.Vector3(x, y, target.size_m)), True, 14.0, True, color, target.name)
    return fg.SceneEntity(now, "world", f"{TARGET_ID}{target.name}", fg.Duration(), True, cubes=[sheet], texts=[text])
