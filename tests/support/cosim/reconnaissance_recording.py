"""Recording of a small reconnaissance: vehicles comb a field in lanes, take pictures, and find two targets."""

import io
import math
from collections.abc import Iterator, Sequence
from functools import cache

import cv2
import numpy as np

from tests.support.cosim.recordings import TENTH, note, states
from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.federate import Event, RunInfo
from vcmvsp.cosim.recording.recorder import Recorder
from vcmvsp.cosim.types import Looks, Mosaic, ProbabilityMap, Sighting, Sightings, frozen
from vcmvsp.physics.world.floor import PlacedTarget
from vcmvsp.physics.world.world import World

SIDE_M, CELL_M = 40.0, 2.0
CELLS = round(SIDE_M / CELL_M)
REACH_M = 5.0
WIDTH, HEIGHT = 320, 240


TARGETS = (
    PlacedTarget(
        name="alpha", size_m=2.0, picture="", color=(224, 32, 160), yaw_rad=0.3, way=((9.0, 20.0), (9.0, 90.0)), speed=0.1
    ),
    PlacedTarget(name="bravo", size_m=2.0, picture="", color=(224, 32, 160), yaw_rad=0.3, way=((31.0, 30.0),)),
)
WORLD = World(targets=TARGETS)


@cache
def jpeg(name: str, number: int) -> bytes:
    """A picture with a yellow square at the target."""
    rng = np.random.default_rng(number)
    pixels = rng.integers(90, 130, (HEIGHT // 8, WIDTH // 8, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    if name:
        corners = cv2.boxPoints(((160.0, 120.0), (40.0, 40.0), -math.degrees(0.3)))
        cv2.fillConvexPoly(pixels, corners.round().astype(np.int32), (0, 220, 240))
    return bytes(cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes())


def pose(vehicle: int, vehicles: int, time_s: float) -> tuple[float, float, float]:
    """Up and down in lanes of its own strip, at 4 m/s."""
    width = SIDE_M / vehicles
    lane, along = divmod(4.0 * time_s, SIDE_M)
    x = vehicle * width + min(0.25 + 0.5 * lane, 0.9) * width
    return (x, along, math.pi / 2) if lane % 2 == 0 else (x, SIDE_M - along, -math.pi / 2)


def events(names: Sequence[str], seconds: float, looks: float = 1.0) -> Iterator[Event]:
    """States at 10 Hz; maps, mosaics, sightings and detections at 1 Hz (``looks``: pictures more often)."""
    middles = CELL_M * (np.arange(CELLS) + 0.5)
    counts = np.zeros((len(names), CELLS, CELLS))
    found: set[tuple[str, str]] = set()
    for k in range(round(seconds * 10) + 1):
        now, time_s = k * SECOND_NS // 10, k / 10
        poses = {name: pose(i, len(names), time_s) for i, name in enumerate(names)}
        yield states(now, poses)
        for i, (name, (x, y, _)) in enumerate(poses.items()):
            if k == 0:
                yield note(name, 0, commander="search", since_s=0.0, why="start", task="search", task_why="start", target="")
            if k % round(10 / looks):
                continue
            away = np.hypot(middles[:, None] - y, middles - x)
            counts[i][away < REACH_M] -= 1.0
            targets = [each for each in TARGETS if math.dist(each.place(time_s), (x, y)) < REACH_M]
            for each in targets:
                column, row = (int(at // CELL_M) for at in each.place(time_s))
                counts[i, row, column] += 3.0
            sightings = tuple(
                Sighting(
                    target=each.name, place=each.place(time_s), centre_px=(160.0, 120.0), angle=0.3, side_px=40.0, score=0.93
                )
                for each in targets
            )
            shown = jpeg(targets[0].name if targets else "", k % 7)
            yield Event(
                f"{name}/sightings",
                now,
                Sightings(sensor="camera", time_ns=now, width=WIDTH, height=HEIGHT, found=sightings, jpeg=shown),
            )
            yield from _noted(name, now, targets, found)
            if k % 10 == 0:
                yield from _mapped(name, now, counts[i])
            cells = np.argwhere(away < REACH_M)[:, ::-1]
            yield Event(
                f"{name}/detector",
                now,
                Looks(time_ns=now, cell_m=CELL_M, cells=frozen(cells, np.int32), hits=frozen(cells[:, 0] > 5)),
            )


def _noted(name: str, now: int, targets: Sequence[PlacedTarget], found: set[tuple[str, str]]) -> Iterator[Event]:
    """A target is found at first sight; later detections only track it."""
    for each in targets:
        if (name, each.name) not in found:
            found.add((name, each.name))
            x, y = each.place(now / SECOND_NS)
            yield note(name, now, found=each.name, found_x=x, found_y=y, commander="track", task="track", target=each.name)
    if not targets and any(finder == name for finder, _ in found):
        yield note(name, now, commander="search", task="search", target="")


def _mapped(name: str, now: int, counts: np.ndarray) -> Iterator[Event]:
    probability = frozen(255.0 / (1.0 + np.exp(-2.2 * counts)), np.uint8)
    values = {"left": 0.0, "bottom": 0.0, "cell_m": CELL_M}
    yield Event(f"{name}/map", now, ProbabilityMap(**values, probability=probability, seen=frozen(counts != 0.0)))
    pixels = np.where(counts[..., None] != 0.0, np.array([90, 120, 80], np.uint8), np.uint8(0))
    yield Event(f"{name}/mosaic", now, Mosaic(**values, pixels=frozen(pixels)))
    yield note(name, now, map_bytes=100.0 * (1 + now // SECOND_NS))


def reconnaissance_recorder(
    names: Sequence[str] = ("uav1", "uav2"), seconds: float = 20.0, *, more: Sequence[Event] = (), looks: float = 1.0
) -> tuple[Recorder, io.BytesIO]:
    """A closed recorder of the reconnaissance, and ``run.mcap``."""
    stream = io.BytesIO()
    run = RunInfo(scenario="reconnaissance", seed=1, duration_ns=round(seconds * SECOND_NS), vehicles=tuple(names))
    agents = [AgentInfo(vehicle=name, agent="x", ticks=TENTH, latency_ns=0, params={}, known=(), taken=()) for name in names]
    recorder = Recorder(run, record_ticks=TENTH, mcap=stream, agents=agents, radius_m={}, world=WORLD)
    for event in sorted([*events(names, seconds, looks), *more], key=lambda event: event.time_ns):
        recorder.on(event)
    recorder.close(run.duration_ns)
    return recorder, stream
