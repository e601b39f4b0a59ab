"""What a detector is worth: how often it sees a target that is there, and one that is not."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from agents.reconnaissance.recognition.detector import Detector
from cosim.types import Array


@dataclass(frozen=True)
class Truth:
    """A target that is in a picture."""

    name: str
    u: float  # px, of its middle
    v: float  # px
    angle: float = 0.0  # rad, counter-clockwise


@dataclass(frozen=True, eq=False)
class Seen:
    """A picture taken straight down, and all targets with their middles in it."""

    image: Array  # (h, w, 3) uint8, RGB
    height_m: float
    focal_px: float
    truths: tuple[Truth, ...] = ()


@dataclass(frozen=True)
class Calibration:
    """Counts of the cells of all footprints: those with a target in them, and those without."""

    targets: int
    found: int  # of them
    empty: int
    false: int  # of them

    @property
    def p(self) -> float:
        """Probability that a detection says target of a cell with one: the mean of its posterior after a flat prior."""
        return (self.found + 1) / (self.targets + 2)

    @property
    def q(self) -> float:
        """Probability that it says target of a cell without; as a posterior mean it is never 0, which no map could bear."""
        return (self.false + 1) / (self.empty + 2)


def calibrate(detector: Detector, frames: Iterable[Seen], cell_m: float) -> Calibration:
    """Counts right and wrong answers in the cells of the pictures: squares on the ground, as in a probability map.

    The cells lie about the middle of each picture, and those that are wholly in it count, once for each target of the detector.
    The answer for a cell is "target" where the middle of a detection lies in it. So a detection that is right but beyond a
    border between cells is a miss of one and a false alarm of the other, as it is for a map.

    Answers of pictures of the same place are not independent: a map that takes each of them as new evidence is surer than it
    should be.
    """
    counts = np.zeros(4, int)
    for frame in frames:
        height, width = frame.image.shape[:2]
        cell_px = cell_m * frame.focal_px / frame.height_m
        columns, rows = int(width / cell_px), int(height / cell_px)
        detections = detector.detect(frame.image, frame.height_m, frame.focal_px)
        for target in detector.targets:
            true, said = np.zeros((rows, columns), bool), np.zeros((rows, columns), bool)
            places = [(one.u, one.v) for one in frame.truths if one.name == target.name]
            answers = [one.centre_px for one in detections if one.target == target.name]
            for cells, points in ((true, places), (said, answers)):
                for u, v in points:
                    i = int(np.floor((v - 0.5 * (height - 1)) / cell_px + 0.5 * rows))
                    j = int(np.floor((u - 0.5 * (width - 1)) / cell_px + 0.5 * columns))
                    if 0 <= i < rows and 0 <= j < columns:
                        cells[i, j] = True
            counts += [true.sum(), (true & said).sum(), (~true).sum(), (~true & said).sum()]
    return Calibration(*counts.tolist())
