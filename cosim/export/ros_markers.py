"""The scene of a recording as ROS 2 markers, for RViz."""

from typing import Any

import numpy as np

from vcmvsp.cosim.export.ros_messages import WORLD, RosMessage, header, make, point, pose, vector
from vcmvsp.cosim.recording.foxglove import messages

ARROW, CUBE, CYLINDER, LINE_STRIP, LINE_LIST, TEXT, TRIANGLES = 0, 1, 3, 4, 5, 9, 11  # visualization_msgs/Marker
DELETE_ALL = 3  # an action
LINE_M = 0.03  # width of lines that have no width in metres
TEXT_M = 0.3  # height of letters, likewise


def markers(said: messages.SceneUpdate, time_ns: int) -> RosMessage:
    """visualization_msgs/MarkerArray: a marker for each primitive; first, one that deletes those of the scene before."""
    listed: list[RosMessage] = [_marker(header=header(time_ns, WORLD), **_nothing(), action=DELETE_ALL) for _ in said.deletions]
    for entity in said.entities:
        parts = [_arrow(each) for each in entity.arrows]
        parts += [_solid(CUBE, each) for each in entity.cubes] + [_solid(CYLINDER, each) for each in entity.cylinders]
        parts += [_line(each) for each in entity.lines] + [_triangles(each) for each in entity.triangles]
        parts += [_text(each) for each in entity.texts]
        for number, fields in enumerate(parts):
            fixed = {"ns": entity.id, "id": number, "frame_locked": entity.frame_locked}
            listed.append(_marker(header=header(time_ns, entity.frame_id), **fixed, **fields))
    return make("visualization_msgs/MarkerArray", markers=listed)


def _marker(**fields: object) -> RosMessage:
    empty = make("sensor_msgs/CompressedImage", header=header(0, ""), format="", data=np.zeros(0, np.uint8))
    usual = {
        "action": 0,
        "lifetime": make("builtin_interfaces/Duration", sec=0, nanosec=0),
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": empty,
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": make("visualization_msgs/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        "mesh_use_embedded_materials": False,
    }
    return make("visualization_msgs/Marker", **{**usual, **fields})


def _nothing() -> dict[str, Any]:
    """Of a marker that draws nothing."""
    shape = {"type": ARROW, "pose": pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), "scale": vector(0.0, 0.0, 0.0)}
    return {"ns": "", "id": 0, "frame_locked": False, "color": make("std_msgs/ColorRGBA", r=0.0, g=0.0, b=0.0, a=0.0), **shape}


def _arrow(said: messages.ArrowPrimitive) -> dict[str, Any]:
    size = vector(said.shaft_length + said.head_length, said.shaft_diameter, said.shaft_diameter)
    return {"type": ARROW, "pose": _posed(said.pose), "scale": size, "color": _color(said.color)}


def _solid(kind: int, said: messages.CubePrimitive | messages.CylinderPrimitive) -> dict[str, Any]:
    size = vector(said.size.x, said.size.y, said.size.z)
    return {"type": kind, "pose": _posed(said.pose), "scale": size, "color": _color(said.color)}


def _line(said: messages.LinePrimitive) -> dict[str, Any]:
    points = [point(each.x, each.y, each.z) for each in said.points]
    if said.type == 1:  # closed
        points.append(points[0])
    width = LINE_M if said.scale_invariant else said.thickness
    kind = LINE_LIST if said.type == 2 else LINE_STRIP
    scale, color = vector(width, 0.0, 0.0), _color(said.color)
    return {"type": kind, "pose": _posed(said.pose), "scale": scale, "color": color, "points": points}


def _triangles(said: messages.TriangleListPrimitive) -> dict[str, Any]:
    points = [point(each.x, each.y, each.z) for each in said.points]
    listed, color = [points[index] for index in said.indices], _color(said.color)
    return {"type": TRIANGLES, "pose": _posed(said.pose), "scale": vector(1.0, 1.0, 1.0), "color": color, "points": listed}


def _text(said: messages.TextPrimitive) -> dict[str, Any]:
    scale, color = vector(0.0, 0.0, TEXT_M if said.scale_invariant else said.font_size), _color(said.color)
    return {"type": TEXT, "pose": _posed(said.pose), "scale": scale, "color": color, "text": said.text}


def _posed(said: messages.Pose) -> RosMessage:
    at, turn = said.position, said.orientation
    return pose((at.x, at.y, at.z), (turn.w, turn.x, turn.y, turn.z))


def _color(said: messages.Color) -> RosMessage:
    return make("std_msgs/ColorRGBA", r=said.r, g=said.g, b=said.b, a=said.a)
