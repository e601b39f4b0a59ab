"""Picture of a world from above: vehicles, the frames of the last tick, and what a task adds."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vcmvsp.cosim.learning.task import Task, Worlds
from vcmvsp.cosim.types import FrameReport

SIZE_PX = 480
_MARGIN = 0.1  # of the side, around everything
_GROUND, _GRID, _VEHICLE, _TARGET = (245, 245, 240), (222, 222, 216), (40, 70, 160), (230, 140, 30)
_RECEIVED, _LOST = (90, 170, 90), (205, 70, 60)


def picture(task: Task, worlds: Worlds, frames: Sequence[FrameReport], names: Sequence[str]) -> NDArray[np.uint8]:
    """The first world from above, north up, (480, 480, 3) RGB; green and red lines: received and lost frames."""
    position = worlds.position[0, :, :2]
    marks = task.marks(worlds)
    everything = np.concatenate([position, marks]) if len(marks) else position
    centre = 0.5 * (everything.min(axis=0) + everything.max(axis=0))
    side_m = max(float(np.ptp(everything, axis=0).max()) * (1.0 + 2.0 * _MARGIN), 8.0)
    side_m = 2.0 ** np.ceil(np.log2(side_m))  # few sizes, so that pictures do not breathe
    centre = np.round(centre / side_m * 8.0) * side_m / 8.0
    image: Any = np.full((SIZE_PX, SIZE_PX, 3), _GROUND, np.uint8)

    def px(point: NDArray[Any]) -> tuple[int, int]:
        x, y = (point - centre) / side_m * SIZE_PX
        return round(SIZE_PX / 2 + float(x)), round(SIZE_PX / 2 - float(y))

    step_m = side_m / 8.0
    for k in range(9):
        line = centre - side_m / 2 + k * step_m
        across, up = px(np.array([line[0], centre[1]]))[0], px(np.array([centre[0], line[1]]))[1]
        cv2.line(image, (across, 0), (across, SIZE_PX), _GRID, 1)
        cv2.line(image, (0, up), (SIZE_PX, up), _GRID, 1)
    row = {name: number for number, name in enumerate(names)}
    for frame in frames:
        for receiver, outcome in zip(frame.receivers, frame.outcome, strict=True):
            ends = px(position[row[frame.sender]]), px(position[row[receiver]])
            cv2.line(image, *ends, _RECEIVED if outcome == "received" else _LOST, 1, cv2.LINE_AA)
    for mark in marks:
        cv2.drawMarker(image, px(mark), _TARGET, cv2.MARKER_CROSS, 12, 2, cv2.LINE_AA)
    for place, yaw, name in zip(position, worlds.yaw[0].tolist(), names, strict=True):
        x, y = px(place)
        cv2.circle(image, (x, y), 8, _VEHICLE, -1, cv2.LINE_AA)
        cv2.line(image, (x, y), (round(x + 15 * np.cos(yaw)), round(y - 15 * np.sin(yaw))), _VEHICLE, 3, cv2.LINE_AA)
        cv2.putText(image, name, (x + 10, y - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (60, 60, 60), 1, cv2.LINE_AA)
    cv2.putText(
        image,
        f"{worlds.time_s[0]:.1f} s   cell {step_m:g} m",
        (8, 16),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.45,
        (60, 60, 60),
        1,
        cv2.LINE_AA,
    )
    return image
