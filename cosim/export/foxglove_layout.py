"""Foxglove and Lichtblick layout for one recording: scene, pictures, speeds, errors, signal levels.

The layout is built from the topics of the recording, so that every panel shows data from the start.
"""

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.recording.foxglove import PICTURE
from vcmvsp.cosim.recording.recorded_run import Source, Values
from vcmvsp.cosim.types import VehicleState
from vcmvsp.cosim.util.files import to_json
from vcmvsp.cosim.util.palette import color_of

FRAMES = "radio/frame"
ERRORS = ("error_m", "z1", "z2")  # names under which followers note their errors, m
WORDS = ("commander", "mode", "status")  # names under which agents note their activity; the first that exists counts
DRAWN = ("foxglove.SceneUpdate", "foxglove.LaserScan", "foxglove.PoseInFrame")
PICTURES = ("foxglove.RawImage", "foxglove.CompressedImage")
Panels = str | dict[str, Any]  # name of a panel, or two parts and the division of the space
MOST_CURVES, MOST_PICTURES = 24, 4
LEAST_VIEW_M, FARTHEST_M = 4.0, 1e8


def write_layout(source: Source, path: Path) -> None:
    """Write the layout into a JSON file."""
    path.write_text(to_json(layout_of(source)), "utf-8")


def layout_of(source: Source) -> dict[str, Any]:
    """The layout: its panels and their arrangement."""
    content = _Content(source)
    panels: dict[str, dict[str, Any]] = {"3D!scene": _scene(content)}
    pictures = [topic for topic, schema in content.topics.items() if schema in PICTURES][:MOST_PICTURES]
    images = {f"Image!{number}": _image(topic, content) for number, topic in enumerate(pictures, 1)}
    panels |= images
    for name, (title, curves) in _plots(content).items():
        if curves:
            panels[f"Plot!{name}"] = _plot(title, curves)
    if content.words:
        paths = [
            {"value": f"{vehicle}/note.values.{name}", "timestampMethod": "receiveTime"} for vehicle, name in content.words
        ]
        panels["StateTransitions!tasks"] = {"paths": paths, "isSynced": True}
    panels["RosOut!log"] = {"topicToRender": "log", "minLogLevel": 1, "searchTerms": []}
    left = _stacked(["3D!scene", *(name for name in panels if name.startswith("StateTransitions!"))], "column", 78)
    above = [_stacked(list(images), "row")] if images else []
    right = _stacked([*above, *(name for name in panels if name.partition("!")[0] in {"Plot", "RosOut"})], "column")
    layout = {"first": left, "second": right, "direction": "row", "splitPercentage": 58}
    fixed = {"globalVariables": {}, "userNodes": {}, "playbackConfig": {"speed": 1}}
    return {"configById": panels, **fixed, "layout": layout}


class _Content:
    def __init__(self, source: Source) -> None:
        values, low, high = Values(), np.full(2, np.inf), np.full(2, -np.inf)
        self.vehicles = source.vehicles
        self.topics: dict[str, str] = {}
        noted: dict[str, dict[str, Any]] = {}

        def is_wanted(topic: str, schema: str) -> bool:
            self.topics[topic] = schema
            return topic.endswith(("/note", "/state"))

        for record in source.only(is_wanted):
            vehicle, _, subtopic = record.topic.partition("/")
            if subtopic == "note":
                noted.setdefault(vehicle, {}).update(values.of(record).values)
            elif subtopic == "state" and isinstance(state := values.of(record), VehicleState):
                low, high = np.fmin(low, state.position[:2]), np.fmax(high, state.position[:2])
        self.noted: Mapping[str, Mapping[str, Any]] = noted
        is_bounded = (np.abs([low, high]) < FARTHEST_M).all()
        self.middle: list[float] = (0.5 * (low + high)).tolist() if is_bounded else [0.0, 0.0]
        self.size_m = max(LEAST_VIEW_M, float((high - low).max())) if is_bounded else LEAST_VIEW_M
        texts = {name for values in noted.values() for name, value in values.items() if isinstance(value, str)}
        keys = [name for name in WORDS if name in texts][:1]
        self.words = [(vehicle, name) for name in keys for vehicle in self.vehicles if name in noted.get(vehicle, {})]

    def curves(self, paths: Sequence[tuple[str, str]]) -> list[dict[str, Any]]:
        """Curves of vehicles, given vehicle and path of the number after its name."""
        curves = paths[:MOST_CURVES]
        return [self._curve(f"{vehicle}/{path}", f"{vehicle} {path.rpartition('.')[2]}", vehicle) for vehicle, path in curves]

    def _curve(self, path: str, label: str, vehicle: str) -> dict[str, Any]:
        look = {"enabled": True, "timestampMethod": "receiveTime", "lineSize": 1.5, "showLine": True}
        return {"value": path, "label": label, "color": color_of(self.vehicles.index(vehicle)), **look}

    def levels(self) -> list[dict[str, Any]]:
        """Curves of the level at all receivers of each sender's frames, if frames are recorded."""
        senders = [name for name in self.vehicles if f"{name}/send" in self.topics][:MOST_CURVES]
        paths = {name: f"{FRAMES}{{sender=={json.dumps(name)}}}.rssi_dbm[:]" for name in senders}
        return [self._curve(path, f"from {name}", name) for name, path in paths.items() if FRAMES in self.topics]

    def of(self, schema: str) -> list[tuple[str, str]]:
        """The topics with this schema, one per vehicle: vehicle, and the rest of the name."""
        subtopics: dict[str, str] = {}
        for topic, each in self.topics.items():
            vehicle, _, subtopic = topic.partition("/")
            if each == schema and vehicle in self.vehicles:
                subtopics.setdefault(vehicle, subtopic)
        return list(subtopics.items())


def _plots(content: _Content) -> dict[str, tuple[str, list[dict[str, Any]]]]:
    wheels = [(vehicle, f"{subtopic}.v") for vehicle, subtopic in content.of("vcmvsp.Odometry")]
    with_wheels = {vehicle for vehicle, _ in wheels}
    flown = [(name, f"state.velocity[{axis}]") for name in content.vehicles if name not in with_wheels for axis in range(2)]
    errors = [
        (vehicle, f"note.values.{name}")
        for vehicle, values in content.noted.items()
        for name in ERRORS
        if isinstance(values.get(name), float | int)
    ]
    return {
        "speed": ("speed [m/s]", content.curves([*wheels, *flown])),
        "formation": ("formation error [m]", content.curves(errors)),
        "radio": ("received power [dBm]", content.levels()),
    }


def _scene(content: _Content) -> dict[str, Any]:
    """The 3D panel, with an oblique view of all tracks from above."""
    topics: dict[str, Any] = {topic: {"visible": True} for topic, schema in content.topics.items() if schema in DRAWN}
    for topic, schema in content.topics.items():
        if schema == "foxglove.LaserScan" and (vehicle := topic.partition("/")[0]) in content.vehicles:
            topics[topic] |= {"colorMode": "flat", "flatColor": color_of(content.vehicles.index(vehicle))}
        elif schema == "foxglove.Grid":
            colors = {"colorMode": "rgba-fields"} if topic.endswith("/mosaic") else {"colorField": "probability"}
            topics[topic] = {"visible": False, **colors}
    step_m = 1.0 if content.size_m < 20.0 else 10.0
    squares = 2 * math.ceil(content.size_m / step_m)
    camera = {
        "perspective": True,
        "distance": 1.6 * content.size_m,
        "phi": 40,
        "thetaOffset": 0,
        "target": [0, 0, 0],
        "targetOffset": [*content.middle, 0],
        "targetOrientation": [0, 0, 0, 1],
        "fovy": 45,
        "near": 0.1,
        "far": 5000,
    }
    grid = {
        "layerId": "foxglove.Grid",
        "instanceId": "grid",
        "label": f"floor, {step_m:g} m",
        "visible": True,
        "frameId": "world",
        "size": step_m * squares,
        "divisions": squares,
        "color": "#80808080",
        "order": 1,
    }
    return {
        "title": "scene",
        "followMode": "follow-none",
        "followTf": "world",
        "cameraState": camera,
        "scene": {"transforms": {"showLabel": False, "axisScale": 0.5}},
        "transforms": {},
        "topics": topics,
        "layers": {"grid": grid},
    }


def _image(topic: str, content: _Content) -> dict[str, Any]:
    annotation_topic = topic.removesuffix(f"/{PICTURE}")
    marks = {annotation_topic: {"visible": True}} if content.topics.get(annotation_topic) == "foxglove.ImageAnnotations" else {}
    return {"title": topic, "imageMode": {"imageTopic": topic, "annotations": marks}}


def _plot(title: str, curves: list[dict[str, Any]]) -> dict[str, Any]:
    look = {"isSynced": True, "xAxisVal": "timestamp", "showLegend": True, "legendDisplay": "floating"}
    return {"title": title, "paths": curves, **look, "showXAxisLabels": True, "showYAxisLabels": True}


def _stacked(parts: Sequence[Panels], direction: str, first_percent: float | None = None) -> Panels:
    """Panels or groups of panels beside or above one another, each with its share."""
    if len(parts) == 1:
        return parts[0]
    share = 100.0 / len(parts) if first_percent is None else first_percent
    rest = _stacked(parts[1:], direction)
    return {"first": parts[0], "second": rest, "direction": direction, "splitPercentage": round(share, 2)}
