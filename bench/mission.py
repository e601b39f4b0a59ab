"""Reconnaissance: recognition in one picture, beside textbook matching of SIFT features; and a whole mission.

``python -m bench.mission`` prints the table. CPU time of this process, medians of pairs: compare the ratios.
"""

import math
import platform
import tomllib
from collections.abc import Callable
from functools import cache, partial

import cv2
import numpy as np

from bench.measure import Row, cpu, in_turn, measured, table
from bench.workloads import run_cpu_s
from vcmvsp.agents.reconnaissance.recognition.detector import Detector
from vcmvsp.agents.reconnaissance.recognition.stages import TargetPicture
from vcmvsp.cosim.analysis.snapshots import Snapshot, Snapshots
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import Array

SCENARIO, SIZE_M = "recon-urban", 2.0
PICTURES, ROUNDS = 40, 5
HEIGHT_M, FOCAL_PX = 22.0, 0.5 * 640.0 / math.tan(0.5 * 1.35)  # of the first vehicle, and of its camera
WITH_MS, WITHOUT_MS = 25.0, 8.0
RUN_S, SPEED = 60.0, 5.0
NEAREST, FEWEST = 0.75, 6  # largest ratio of the distances of the two best matches, and matches that make a target


def rows() -> list[Row]:
    """All rows."""
    return measured((with_a_target, without_one, run))


def with_a_target() -> Row:
    """Pictures with a target in them."""
    return _row("with a target", [each for each in _pictures() if each.targets and each.sightings], WITH_MS)


def without_one() -> Row:
    """Pictures of streets and roofs without a target."""
    return _row("without one", [each for each in _pictures() if not each.targets], WITHOUT_MS)


def run() -> Row:
    """The whole mission, beside its pictures alone."""
    text = tomllib.loads(scenarios.text_of(SCENARIO)) | {"duration_s": RUN_S}
    frames = 2 * 5.0 * RUN_S

    def pictures() -> float:
        snapshots = Snapshots(SCENARIO)
        return cpu(lambda: [snapshots.take(n, PICTURES) for n in range(PICTURES)]) * frames / PICTURES

    ours, other, ratio = in_turn(lambda: run_cpu_s(text), pictures, 3)
    name = f"`{SCENARIO}`, two 5 Hz cameras of 640 x 480, all recorded; beside as many pictures, taken and searched, alone"
    speed = RUN_S / ours
    return Row(name, f"{speed:.1f} sim s / CPU s", f"{RUN_S / other:.1f}", ratio, f"goal: >= {SPEED:g}", speed >= SPEED)


@cache
def _pictures() -> list[Snapshot]:
    snapshots = Snapshots(SCENARIO)
    return [snapshots.take(number, PICTURES) for number in range(PICTURES)]


def _targets() -> list[TargetPicture]:
    folder = scenarios.path_of(SCENARIO).parent / "targets"
    return [TargetPicture.load(name, folder / f"{name}.png", SIZE_M) for name in ("alpha", "bravo")]


def _row(content: str, pictures: list[Snapshot], limit_ms: float) -> Row:
    targets = _targets()
    detector, features = Detector(targets), Sift([each.picture for each in targets])

    def ours() -> float:
        return _median(lambda one: detector.detect(one.pixels, HEIGHT_M, FOCAL_PX), pictures)

    def other() -> float:
        return _median(lambda one: features.found(one.pixels), pictures)

    our_s, other_s, ratio = in_turn(ours, other, ROUNDS)
    name = f"a picture of 640 x 480 {content}, searched for two targets; beside OpenCV's SIFT, matched"
    return Row(
        name, f"{1e3 * our_s:.1f} ms", f"{1e3 * other_s:.1f} ms", ratio, f"goal: <= {limit_ms:g} ms", 1e3 * our_s <= limit_ms
    )


def _median(look: Callable[[Snapshot], object], pictures: list[Snapshot]) -> float:
    """CPU seconds for a picture."""
    return float(np.median([cpu(partial(look, one)) for one in pictures]))


class Sift:
    """Targets of a list in a picture, by features that are invariant to rotation and scale (Lowe 2004)."""

    def __init__(self, targets: list[Array]) -> None:
        self._sift, self._matcher = cv2.SIFT_create(), cv2.BFMatcher()  # type: ignore[attr-defined]
        self._targets = [self._sift.detectAndCompute(each, None) for each in targets]

    def found(self, picture: Array) -> list[bool]:
        """By target: whether enough of its features are there, in one place and with one rotation."""
        points, features = self._sift.detectAndCompute(picture, None)
        if features is None:
            return [False] * len(self._targets)
        found = []
        for keypoints, descriptors in self._targets:
            pairs = self._matcher.knnMatch(descriptors, features, k=2)
            good = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < NEAREST * pair[1].distance]
            if len(good) < FEWEST:
                found.append(False)
                continue
            here = np.array([points[each.trainIdx].pt for each in good])
            there = np.array([keypoints[each.queryIdx].pt for each in good])
            _, inliers = cv2.estimateAffinePartial2D(there, here)
            found.append(inliers is not None and int(inliers.sum()) >= FEWEST)
        return found


def main() -> None:
    """Print the table."""
    print(f"Python {platform.python_version()}, OpenCV {cv2.__version__}\n")
    print(table(rows()))


if __name__ == "__main__":
    main()
