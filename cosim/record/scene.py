"""The drawing of a run in a 3D viewer: body, heading and name of each vehicle, the place that each follower keeps, targets."""

import math
from collections.abc import Mapping, Sequence

from cosim.clock import SECOND_NS
from cosim.record.foxglove import (
    ArrowPrimitive,
    Color,
    CubePrimitive,
    CylinderPrimitive,
    Duration,
    LinePrimitive,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    TextPrimitive,
    Time,
    Vector3,
)
from cosim.record.metrics import Target
from cosim.record.palette import TARGET, rgb, rgb_of
from cosim.types import Follows

TARGET_HEIGHT_M = 0.05
DEFAULT_RADIUS_M = 0.25  # for a vehicle of which no radius is known
_RING = [(math.cos(i * math.tau / 24), math.sin(i * math.tau / 24)) for i in range(24)]


def scene(
    vehicles: Sequence[str],
    radius_m: Mapping[str, float],
    places: Mapping[str, Follows],
    time_ns: int,
    targets: Sequence[Target] = (),
) -> SceneUpdate:
    """The whole scene: entities move with the frames of their vehicles, and stay until the next scene replaces them."""
    now, entities = Time.of(time_ns), []
    for index, name in enumerate(vehicles):
        color, radius = Color(*rgb_of(index)), radius_m.get(name, DEFAULT_RADIUS_M)
        entities.append(_body(name, radius, color, now))
        if name in places and places[name].leader is not None:
            entities.append(_place(name, places[name], radius, color, now))
    return SceneUpdate([*entities, *(_target(target, now, time_ns / SECOND_NS) for target in targets)])


def _body(name: str, radius: float, color: Color, now: Time) -> SceneEntity:
    """A cylinder about the vehicle's centre with an arrow ahead and the name above."""
    cylinder = CylinderPrimitive(
        Pose(), Vector3(2 * radius, 2 * radius, radius), 1.0, 1.0, Color(color.r, color.g, color.b, 0.8)
    )
    ahead = Pose(Vector3(0.0, 0.0, 0.5 * radius))
    arrow = ArrowPrimitive(ahead, 1.2 * radius, 0.2 * radius, 0.5 * radius, 0.5 * radius, color)
    text = TextPrimitive(Pose(Vector3(0.0, 0.0, 1.6 * radius)), True, 14.0, True, color, name)
    return SceneEntity(now, name, name, Duration(), True, arrows=[arrow], cylinders=[cylinder], texts=[text])


def _place(name: str, follows: Follows, radius: float, color: Color, now: Time) -> SceneEntity:
    """A thin line from the leader to the follower's place, and the follower's outline there."""
    x, y = follows.slot
    line = LinePrimitive(0, Pose(), 1.5, True, [Vector3(), Vector3(x, y)], color)
    ring = [Vector3(x + radius * c, y + radius * s) for c, s in _RING]
    outline = LinePrimitive(1, Pose(), 1.5, True, ring, color)
    return SceneEntity(now, str(follows.leader), f"{name}/place", Duration(), True, lines=[line, outline])


def _target(target: Target, now: Time, time_s: float) -> SceneEntity:
    """A sheet on the ground, and its name above it."""
    (x, y), half = target.place(time_s), 0.5 * target.yaw(time_s)
    pose = Pose(Vector3(x, y), Quaternion(z=math.sin(half), w=math.cos(half)))
    color = Color(*rgb(TARGET), 0.6)
    sheet = CubePrimitive(pose, Vector3(target.size_m, target.size_m, TARGET_HEIGHT_M), color)
    text = TextPrimitive(Pose(Vector3(x, y, target.size_m)), True, 14.0, True, color, target.name)
    return SceneEntity(now, "world", f"target/{target.name}", Duration(), True, cubes=[sheet], texts=[text])
