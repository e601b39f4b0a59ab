"""Recognition of targets from 10 to 40 m: recall, precision, and the contribution of each stage.

On synthetic ground, and in pictures of a platform camera over a town with the same target and likenesses.
"""

import math
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from itertools import islice, starmap
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis.snapshots import Rates, Snapshots
from vcmvsp.cosim.assembly.parts.recognition import Detection, Detector
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel, Photo
from vcmvsp.cosim.reproduction.figures.search.synthetic_pictures import (
    SIZE_M,
    Tally,
    box,
    photographed,
    synthetic_frame,
    tallied,
    target,
    together,
    town,
)
from vcmvsp.cosim.reproduction.row import Row, absolute
from vcmvsp.cosim.reproduction.runner import Runner
from vcmvsp.cosim.types import Sighting

HEIGHTS = (10.0, 15.0, 20.0, 30.0, 40.0)  # m
FRAMES = 60  # at each height
PARTS = 3  # jobs for each height
TOWNS = (1, 2, 3)  # seeds
PHOTO = (8, 20)  # number of the town picture that is shown, and their total
STAGES = ("colour", "and rings", "and match")
SHOWN = ((10.0, 1), (40.0, 2))  # heights and numbers of the pictures that are shown
REFERENCE = (0.05, 0.44, 1.0)  # an independent implementation's precision with one, two and three stages
PRECISION, RECALL, ANGLE_DEG, PLACE = 0.95, 0.90, 1.0, 0.05  # requirements


def recognition(runner: Runner, frames: int = FRAMES) -> Figure:
    """Precision and recall by height, with one, two and three stages; examples."""
    parts = [np.arange(frames)[part::PARTS].tolist() for part in range(PARTS)]
    jobs: list[Callable[[], Any]] = [partial(tallied, height, part) for height in HEIGHTS for part in parts]
    jobs += [partial(photographed, height, frames // len(TOWNS), TOWNS) for height in HEIGHTS]
    answers = iter(runner(jobs))
    by_height = [_joined(list(islice(answers, PARTS))) for _ in HEIGHTS]
    rows: list[Row] = []
    for height, (*_, each) in zip(HEIGHTS, by_height, strict=True):
        rows += [
            absolute(f"made-up ground, {height:g} m: precision", 1.0, each.precision.value, 1.0 - PRECISION),
            absolute(f"made-up ground, {height:g} m: recall", 1.0, each.recall.value, 1.0 - RECALL),
            absolute(f"made-up ground, {height:g} m: median error of the angle, deg", 0.0, _degrees(each), ANGLE_DEG),
            absolute(f"made-up ground, {height:g} m: median error of the place, sides", 0.0, _sides(each), PLACE),
        ]
    of_stages = _joined(by_height)
    cameras: list[Rates] = list(answers)
    for height, rates in zip(HEIGHTS, cameras, strict=True):
        degrees, sides = math.degrees(np.median(rates.angles)), float(np.median(rates.places)) / SIZE_M
        rows += [
            absolute(f"town, {height:g} m: precision", 1.0, rates.precision.value, 1.0 - PRECISION),
            absolute(f"town, {height:g} m: recall, unoccluded", 1.0, rates.unoccluded.value, 1.0 - RECALL),
            absolute(f"town, {height:g} m: median error of the angle, deg", 0.0, degrees, ANGLE_DEG),
            absolute(f"town, {height:g} m: median error of the place, sides", 0.0, sides, PLACE),
        ]
    rows += [
        absolute(f"stage {name}: precision", must, tally.precision.value, 0.15)
        for name, must, tally in zip(STAGES, REFERENCE, of_stages, strict=True)
    ]
    rows.append(absolute("stage and rings: recall", 1.0, of_stages[1].recall.value, 1.0 - RECALL))
    precisions = [each.precision.value for each in cameras]
    recalls = [each.unoccluded.value for each in cameras]
    panels = [
        _shares("Precision", by_height, precisions, PRECISION),
        _shares("Recall", by_height, recalls, RECALL),
        _errors([each[-1] for each in by_height]),
        *starmap(_example, SHOWN),
        _photo(),
    ]
    return Figure("Recognition in three stages, one target and five likenesses of it in each picture", panels, rows, columns=3)


def _joined(parts: Sequence[Sequence[Tally]]) -> list[Tally]:
    return [together(each) for each in zip(*parts, strict=True)]


def _degrees(each: Tally) -> float:
    return math.degrees(np.median(each.angles)) if each.angles else math.nan


def _sides(each: Tally) -> float:
    return float(np.median(each.places)) if each.places else math.nan


def _shares(title: str, by_height: list[list[Tally]], cameras: list[float], required: float) -> Panel:
    x, name, curves = np.array(HEIGHTS), title.lower(), []
    for color, (stage, tallies) in enumerate(zip(STAGES, zip(*by_height, strict=True), strict=True), 1):
        curves.append(Curve(x, np.array([getattr(each, name).value for each in tallies]), stage, color, "both"))
    curves.append(Curve(x, np.array(cameras), "camera over a town", 0, "hollow"))
    return Panel(title, "height [m]", name, curves, levels={"asked for": required}, y_limits=(0.0, 1.05))


def _errors(tallies: list[Tally]) -> Panel:
    x = np.array(HEIGHTS)
    angles, places = np.array([(_degrees(each) / ANGLE_DEG, _sides(each) / PLACE) for each in tallies]).T
    curves = [
        Curve(x, angles, f"angle, in {ANGLE_DEG:g} deg", 1, "both"),
        Curve(x, places, f"place, in {PLACE:g} sides", 2, "both"),
    ]
    return Panel("Median errors", "height [m]", "error", curves, levels={"asked for": 1.0}, y_limits=(0.0, 1.5))


def _example(height_m: float, number: int) -> Panel:
    frame = synthetic_frame(height_m, number)
    detector = Detector([target()])
    detections = detector.detect(frame.image, height_m, frame.seen.focal_px)
    alike = [box(u, v, 1.5 * frame.side_px, 0.0, "likeness", 6) for _, u, v in frame.likenesses]
    marks = _recognised(detections)
    if not detections:
        marks = [box(truth.u, truth.v, 1.6 * frame.side_px, 0.0, "missed", 2) for truth in frame.seen.truths]
    title = f"From {height_m:g} m: a side has {frame.side_px:g} px"
    return Panel(title, "u [px]", "v [px]", [*alike, *marks], photo=Photo(frame.image))


def _photo() -> Panel:
    with tempfile.TemporaryDirectory() as folder:
        snapshots = Snapshots(town(Path(folder), 20.0, TOWNS[-1])).take(*PHOTO)
    boxes = _recognised(snapshots.sightings)
    return Panel("A camera over a town, from 20 m", "u [px]", "v [px]", boxes, photo=Photo(snapshots.pixels))


def _recognised(places: Sequence[Detection | Sighting]) -> list[Curve]:
    return [box(*each.centre_px, 1.3 * each.side_px, each.angle, "recognised", 0) for each in places]
