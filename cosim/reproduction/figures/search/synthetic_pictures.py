"""Detection rates in synthetic pictures of the ground with known targets and likenesses.

The pictures: 640 x 480 px, focal length 400 px, textured ground, roads, three to seven roofs, half of them coloured, light from
0.75 to 1.2, noise of 6 levels; one target of 2 m at any angle, and likenesses of equal size: a mirror image, one cut into 16
pieces, one of a single colour, one in other hues, and another picture in the target's colours.
"""

import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vcmvsp.cosim.analysis.snapshots import NONE, Rates, Share, Snapshots
from vcmvsp.cosim.assembly.parts.recognition import Detection, Detector, TargetPicture, ground
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.reproduction.figures.figure import Curve

NEAR = 0.25  # in sides: maximum distance of a right detection from the target's centre
SIZE_M = 2.0
KINDS = ("target", "mirrored", "scrambled", "solid", "recoloured", "other")


@dataclass
class Tally:
    """Detection counts over pictures."""

    precision: Share = NONE  # of the detections, those that are right
    recall: Share = NONE  # of the targets, those that are found
    angles: list[float] = field(default_factory=list)  # errors, rad
    places: list[float] = field(default_factory=list)  # errors, sides

    def add(self, detections: Sequence[Detection], truths: Sequence[ground.Truth], side_px: float) -> None:
        """Count the detections of a picture; ``truths`` are all targets in it, each of which counts as found once."""
        unmatched = list(detections)
        for truth in truths:
            matches = [
                detection
                for detection in unmatched
                if detection.target == truth.name and _apart(detection, truth) < NEAR * side_px
            ][:1]
            self.recall = self.recall.plus(bool(matches))
            for detection in matches:
                unmatched.remove(detection)
                self.precision = self.precision.plus(True)
                self.angles.append(abs(wrap(detection.angle - truth.angle)))
                self.places.append(_apart(detection, truth) / side_px)
        self.precision = self.precision.plus(*(False for _ in unmatched))


def together(tallies: Iterable[Tally]) -> Tally:
    """Merge the tallies of several pictures."""
    total = Tally()
    for each in tallies:
        total.precision = total.precision.joined(each.precision)
        total.recall = total.recall.joined(each.recall)
        total.angles += each.angles
        total.places += each.places
    return total


def target() -> TargetPicture:
    """The target of the synthetic pictures."""
    return TargetPicture("glyph", ground.glyph(), SIZE_M)


def synthetic_frame(height_m: float, number: int) -> ground.SyntheticFrame:
    """A reproducible picture of the ground: ``image``, ``seen``, ``likenesses``, ``side_px``."""
    return ground.frame(np.random.default_rng([round(10 * height_m), number]), height_m)


def tallied(height_m: float, numbers: Sequence[int]) -> tuple[Tally, Tally, Tally]:
    """Tallies with the first stage alone, with two and with all three."""
    sample, tallies = target(), (Tally(), Tally(), Tally())
    detectors = [Detector([sample], stages=stages) for stages in (1, 2, 3)]
    for number in numbers:
        frame = synthetic_frame(height_m, number)
        for detector, tally in zip(detectors, tallies, strict=True):
            detections = detector.detect(frame.image, height_m, frame.seen.focal_px)
            tally.add(detections, frame.seen.truths, frame.side_px)
    return tallies


def town(folder: Path, height_m: float, seed: int) -> dict[str, Any]:
    """A scenario of a vehicle above a town with a target and likenesses; writes their pictures into a folder."""
    pictures = [ground.glyph(), *ground.likenesses(ground.glyph(), np.random.default_rng(seed))]
    for name, picture in zip(KINDS, pictures, strict=True):
        ground.save(picture, folder / f"{name}.png")
    files = {name: str(folder / f"{name}.png") for name in KINDS}
    camera = {
        "kind": "nadir_camera",
        "width": 640,
        "height": 480,
        "field_of_view": 2.0 * math.atan(320.0 / 400.0),
        "noise": 3.0,
    }
    turns = np.random.default_rng([seed, 1]).uniform(-math.pi, math.pi, len(KINDS)).tolist()
    return {
        "name": "town",
        "duration_s": 60.0,
        "seed": seed,
        "world": {
            "kind": "urban",
            "size": (62.0, 62.0),
            "block": 10.0,
            "street": 8.0,
            "lots": 1,
            "height_min": 3.0,
            "height_max": 8.0,
            "targets": [
                {"name": name, "picture": file, "size": SIZE_M, "yaw_rad": turn}
                for (name, file), turn in zip(files.items(), turns, strict=True)
            ],
        },
        "vehicle": [
            {
                "name": "uav1",
                "kind": "quadrotor",
                "position": (0.0, 0.0, height_m),
                "sensors": {"camera": camera},
                "agent": {
                    "kind": "track",
                    "watching": {"targets": [{"name": KINDS[0], "picture": files[KINDS[0]], "size_m": SIZE_M}]},
                },
            }
        ],
    }


def photographed(height_m: float, frames: int, seeds: Sequence[int]) -> Rates:
    """Detection rates in pictures of a platform camera over towns, with the vehicle tilted by up to 5 deg."""
    rates = Rates()
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            snapshots = Snapshots(town(Path(folder), height_m, seed), seed=seed)
            for number in range(frames):
                rates.add(snapshots.take(number, frames))
    return rates


def box(u: float, v: float, side_px: float, angle: float, label: str, color: int) -> Curve:
    """A square in a picture, rotated counter-clockwise in the view."""
    along, across = np.array([0.5, -0.5, -0.5, 0.5, 0.5]), np.array([0.5, 0.5, -0.5, -0.5, 0.5])
    c, s = math.cos(angle), math.sin(angle)
    x, y = side_px * (c * across - s * along), side_px * (s * across + c * along)  # y up
    return Curve(u + x, v - y, label, color)


def _apart(detection: Detection, truth: ground.Truth) -> float:
    u, v = detection.centre_px
    return math.hypot(u - truth.u, v - truth.v)
