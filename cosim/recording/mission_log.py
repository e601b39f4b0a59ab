"""Reads the data of a reconnaissance mission from ``run.mcap``, for figures drawn after the run.

Reading after the run costs the run no memory, and a saved run can be drawn again. Memory is bounded for runs of any length: at
most `FRAMES` maps and camera pictures per vehicle, spread evenly over time.
"""

import contextlib
from dataclasses import dataclass, field
from typing import BinaryIO

import msgspec
import numpy as np

from vcmvsp.cosim.metrics.mission import Mission
from vcmvsp.cosim.recording.foxglove import CompressedImage, Grid, ImageAnnotations
from vcmvsp.cosim.recording.mcap_reader import messages
from vcmvsp.cosim.recording.recorded_run import Noted
from vcmvsp.cosim.types import Array, Mosaic, Presence, ProbabilityMap, Sightings
from vcmvsp.cosim.util.documents import json_reader

FRAMES = 450

_read_grid = json_reader(Grid)
_read_sightings = json_reader(ImageAnnotations)
_read_picture = json_reader(CompressedImage)
_read_note = json_reader(Noted)
_read_presence = json_reader(Presence)


@dataclass
class MissionLog:
    """Maps, pictures, sightings and notes of the vehicles, with their times, ns.

    Keeps all sightings with a detection or a picture, and one picture for each part of the run: the last one with a detection,
    else the last one.
    """

    vehicles: tuple[str, ...]
    end_ns: int
    noted: Mission = field(default_factory=Mission)  # commanders over time, and finds
    maps: dict[str, list[tuple[int, ProbabilityMap]]] = field(default_factory=dict)  # the newest in each part of the run
    sightings: dict[str, list[tuple[int, Sightings]]] = field(default_factory=dict)
    mosaics: dict[str, Mosaic] = field(default_factory=dict)  # the newest

    def __bool__(self) -> bool:
        return bool(self.noted or self.maps or self.sightings or self.mosaics)

    def part(self, time_ns: int) -> int:
        """Index of the part of the run that contains a time."""
        return time_ns * FRAMES // max(self.end_ns + 1, FRAMES)


def read_mission(stream: BinaryIO, vehicles: tuple[str, ...], end_ns: int) -> MissionLog:
    """Read a recording; of a damaged one, the part before the damage."""
    log = MissionLog(vehicles, end_ns)
    with contextlib.suppress(ValueError, LookupError):  # not a mission message, or an unreadable picture
        for topic, time_ns, data in messages(stream):
            vehicle, _, subtopic = topic.partition("/")
            if vehicle in vehicles:
                _take(log, vehicle, subtopic, time_ns, data)
    for vehicle, sightings in log.sightings.items():
        log.sightings[vehicle] = [each for each in sightings if each[1].found or each[1].jpeg]
    return log


def surest_map(log: MissionLog, now_ns: int) -> tuple[ProbabilityMap | None, Array]:
    """For each cell, the probability furthest from one half among the vehicles' maps at that time, in 255ths.

    Uses the grid of the first vehicle with a map and ignores other grids. Also returns that map, which holds the grid's origin.
    """
    maps: list[ProbabilityMap] = []
    for shown in log.maps.values():
        maps += [grid for time_ns, grid in shown if time_ns <= now_ns][-1:]
    if not maps:
        return None, np.zeros((0, 0), np.uint8)
    same = [each for each in maps if _grid_of(each) == _grid_of(maps[0])]
    values = np.stack([each.probability for each in same])
    sure = np.abs(2 * values.astype(int) - 255).argmax(axis=0)
    return maps[0], np.take_along_axis(values, sure[None], axis=0)[0]


def _take(log: MissionLog, vehicle: str, subtopic: str, time_ns: int, data: bytes) -> None:
    match subtopic:
        case "note":
            log.noted.take(vehicle, time_ns, _read_note(data).values)
        case "host":
            back = _read_presence(data).state == "back"
            (log.noted.restore if back else log.noted.leave)(vehicle, time_ns)
        case "map":
            _take_map(log, vehicle, time_ns, data)
        case "mosaic":
            content = _read_grid(data).content
            if isinstance(content, Mosaic):
                log.mosaics[vehicle] = content
        case "sightings":
            _take_sightings(log, vehicle, time_ns, data)
        case "sightings/picture":
            _take_picture(log, vehicle, data)


def _take_map(log: MissionLog, vehicle: str, time_ns: int, data: bytes) -> None:
    content, maps = _read_grid(data).content, log.maps.setdefault(vehicle, [])
    if maps and log.part(maps[-1][0]) == log.part(time_ns):
        maps.pop()
    if isinstance(content, ProbabilityMap):
        maps.append((time_ns, content))


def _take_sightings(log: MissionLog, vehicle: str, time_ns: int, data: bytes) -> None:
    sightings = log.sightings.setdefault(vehicle, [])
    if sightings and not (sightings[-1][1].found or sightings[-1][1].jpeg):  # nothing to show
        sightings.pop()
    sightings.append((time_ns, _read_sightings(data).sightings()))


def _take_picture(log: MissionLog, vehicle: str, data: bytes) -> None:
    """Keep the picture of the newest sightings unless this part of the run has a better one; drop the worse one."""
    sightings = log.sightings[vehicle]
    time_ns, newest = sightings[-1]
    for place in range(len(sightings) - 2, -1, -1):
        before_ns, before = sightings[place]
        if log.part(before_ns) != log.part(time_ns):
            break
        if before.jpeg and before.found and not newest.found:
            return
        sightings[place] = before_ns, msgspec.structs.replace(before, jpeg=b"")
    sightings[-1] = time_ns, msgspec.structs.replace(newest, jpeg=_read_picture(data).data)


def _grid_of(grid: ProbabilityMap) -> tuple[float, ...]:
    return grid.left, grid.bottom, grid.cell_m, *grid.probability.shape
