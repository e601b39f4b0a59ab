"""Recognition in three stages: each is more exact and slower than the one before, and examines only what that one passed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from vcmvsp.agents.reconnaissance.recognition.stages import (
    APART,
    COARSE,
    FULL,
    PATCH,
    SIDE_PX,
    MatchedPose,
    Rings,
    Signature,
    TargetPicture,
    Template,
    colour_peaks,
    colour_scores,
    match,
    product,
    rotation,
)
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array

SMALLEST_PX = 12  # of a target's side in the picture: smaller targets are not recognised
RINGS = 0.88  # cosine of the second stage
HOPEFUL, PROMISING = 0.60, 0.80  # the same with few samples, on a coarse and a finer grid; patches below are dropped
MATCH = 0.75  # correlation of the third stage
FINEST = 1.2  # pictures are reduced if the target is larger than this many patches
MOVES = 0.3  # sides by which a middle may still move after the first stage
AROUND = 0.72 + MOVES  # sides around a region that are examined too: half a diagonal more

# tried patches: to the right and down, in sides, and scale
AROUND_IT = np.array([(0.12 * i, 0.12 * j, 1.0) for j in range(-1, 2) for i in range(-1, 2)])
NEAR_IT = np.array([(0.06 * i, 0.06 * j, 1.0) for j in range(-1, 2) for i in range(-1, 2)])
CLOSE_TO_IT = np.array([(0.045 * i, 0.045 * j, 1.0) for j in range(-1, 2) for i in range(-1, 2)])
LARGER_OR_SMALLER = np.array([(0.0, 0.0, scale) for scale in (0.88, 0.94, 1.0, 1.06, 1.12)])  # heights are known to some 10 %

Region = tuple[float, float, float, float]  # left, top, right, bottom, px


@dataclass(frozen=True)
class Detection:
    """A target recognised in a picture."""

    target: str
    centre_px: tuple[float, float]  # u to the right, v down; middles of pixels are whole numbers
    angle: float  # rad in [-pi, pi), by which its picture is turned, counter-clockwise as one looks at it
    side_px: float  # as it was found, to some 3 %
    colour: float  # score of the first stage, in [0, 1]
    rings: float  # of the second
    match: float  # of the third


@dataclass(frozen=True)
class _Search:
    """A part of a picture, possibly reduced."""

    image: Array
    left: int
    top: int
    inside: Region  # where middles of targets are looked for, px of the whole picture
    scale: float = 1.0  # about so many of its pixels per pixel of the whole picture
    exact: tuple[float, float] = (1.0, 1.0)  # to the right and down: it has whole pixels

    def reduced(self, scale: float) -> "_Search":
        """The part with fewer pixels."""
        if scale > 1.0 / FINEST:
            return self
        image, whole, rest = self.image, 1, scale
        while rest < 0.5 and min(image.shape[:2]) > 1:  # halving whole pixels is much faster than other averages
            height, width = image.shape[0] // 2, image.shape[1] // 2
            image = cv2.resize(image[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)
            whole, rest = 2 * whole, 2.0 * rest
        size = [max(1, round(rest * n)) for n in (image.shape[1], image.shape[0])]
        exact = size[0] / (whole * image.shape[1]), size[1] / (whole * image.shape[0])
        return replace(self, image=cv2.resize(image, size, interpolation=cv2.INTER_LINEAR), scale=scale, exact=exact)

    def within(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Places of the whole picture in this one; the edges of pixels coincide, not their middles."""
        return (u - self.left + 0.5) * self.exact[0] - 0.5, (v - self.top + 0.5) * self.exact[1] - 0.5

    def outside(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Places of this picture in the whole one."""
        return (u + 0.5) / self.exact[0] - 0.5 + self.left, (v + 0.5) / self.exact[1] - 0.5 + self.top


class Detector:
    """Recognises targets in pictures taken straight down from a known height.

    ``stages`` may leave out later ones, to compare their effects.
    """

    def __init__(self, targets: Sequence[TargetPicture], *, stages: int = 3) -> None:
        if not targets:
            raise ScenarioError("at least one target is needed", key="targets")
        if len({target.name for target in targets}) < len(targets):
            raise ScenarioError("targets must have different names", key="targets")
        self.targets = tuple(targets)
        self._stages = stages

    def detect(self, image_rgb: Array, height_m: float, focal_px: float, region: Region | None = None) -> list[Detection]:
        """All targets with their middle in the region (None: in the picture, (h, w, 3) uint8), the surest first.

        ``height_m``: of the camera above the targets.
        """
        if not (height_m > 0.0 and focal_px > 0.0 and math.isfinite(height_m + focal_px)):
            return []
        detections: list[Detection] = []
        for size_m in sorted({target.size_m for target in self.targets}):  # once for all targets of one size
            side = size_m * focal_px / height_m
            if SMALLEST_PX <= side <= min(image_rgb.shape[:2]) and (part := _part(image_rgb, side, region)) is not None:
                detections += self._of_size(size_m, side, part)
        if region is not None:
            left, top, right, bottom = region
            detections = [
                detection
                for detection in detections
                if left <= detection.centre_px[0] <= right and top <= detection.centre_px[1] <= bottom
            ]
        detections.sort(key=lambda detection: -detection.match)
        distinct: list[Detection] = []
        for detection in detections:  # one place holds one target
            if not any(_same_place(detection, other) for other in distinct):
                distinct.append(detection)
        return distinct

    def _of_size(self, size_m: float, side: float, search: _Search) -> list[Detection]:
        small = search.reduced(SIDE_PX / side)
        hsv = cv2.cvtColor(small.image, cv2.COLOR_RGB2HSV)
        window = round(0.5 * (side * small.scale - 1.0)) * 2 + 1  # odd
        sharp: _Search | None = None
        detections: list[Detection] = []
        for target in self.targets:
            if target.size_m != size_m:
                continue
            template = target.template(round(side))
            score = colour_scores(hsv, template.hues, window)
            peaks = colour_peaks(score, window, _inside(small, search.inside))
            if not len(peaks):
                continue
            places = np.column_stack([*small.outside(peaks[:, 0], peaks[:, 1]), peaks[:, 2]])
            sharp = sharp or search.reduced(PATCH / side)
            detections += self._judge(target.name, template, places, sharp, side)
        return detections

    def _judge(self, name: str, template: Template, places: Array, search: _Search, side: float) -> list[Detection]:
        """Detections after the later stages, of places (n, 3): u, v px of the whole picture and score."""
        if self._stages == 1:
            return [Detection(name, (u, v), 0.0, side, score, 0.0, 0.0) for u, v, score in places.tolist()]
        u, v = search.within(places[:, 0], places[:, 1])
        px = np.full(len(u), side * search.scale)
        for tries, least in ((AROUND_IT, HOPEFUL), (NEAR_IT, PROMISING)):
            u, v, px, rings, _ = _best(COARSE, template.coarse, search.image, u, v, px, tries)
            candidates = rings >= least
            if not candidates.any():
                return []
            u, v, px, places = u[candidates], v[candidates], px[candidates], places[candidates]
        u, v, px, _, _ = _best(FULL, template.full, search.image, u, v, px, CLOSE_TO_IT)
        u, v, px, rings, spectra = _best(FULL, template.full, search.image, u, v, px, LARGER_OR_SMALLER)
        detections = []
        for i in np.flatnonzero(rings >= RINGS).tolist():
            angle = rotation(spectra[:, i], template.full.spectra[:, 0])
            pose, score = MatchedPose(float(u[i]), float(v[i]), angle, float(px[i])), 0.0
            if self._stages == 3:
                score, pose = match(search.image, template, pose)
                if score < MATCH:
                    continue
            across, down = search.outside(np.array([pose.u]), np.array([pose.v]))
            centre, size = (float(across[0]), float(down[0])), pose.side_px / search.scale
            detections.append(Detection(name, centre, wrap(pose.angle), size, float(places[i, 2]), float(rings[i]), score))
        return detections


def _same_place(a: Detection, b: Detection) -> bool:
    return math.dist(a.centre_px, b.centre_px) <= APART * min(a.side_px, b.side_px)


def _best(
    rings: Rings, sizes: Signature, image: Array, u: Array, v: Array, px: Array, tries: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """Of the variants of n patches the one most like the target: u, v, side px, cosine (n,), spectra (9, n, m)."""
    us = (u[:, None] + px[:, None] * tries[:, 0]).ravel()
    vs = (v[:, None] + px[:, None] * tries[:, 1]).ravel()
    sides = (px[:, None] * tries[:, 2]).ravel()
    spectra = rings.spectra(image, us, vs, sides)
    cosines = product(rings.signatures(spectra).unit, sizes.unit.T).reshape(len(u), -1)
    best = np.arange(len(u)) * len(tries) + cosines.argmax(axis=1)
    return us[best], vs[best], sides[best], cosines.max(axis=1), spectra[:, best]


def _part(image: Array, side: float, region: Region | None) -> _Search | None:
    """The region with a margin of a target's size; None if it lies outside the picture."""
    height, width = image.shape[:2]
    left, top, right, bottom = (0.0, 0.0, float(width), float(height)) if region is None else region
    left, top, right, bottom = max(left, 0.0), max(top, 0.0), min(right, float(width)), min(bottom, float(height))
    if left >= right or top >= bottom:
        return None
    x0, y0 = max(math.floor(left - AROUND * side), 0), max(math.floor(top - AROUND * side), 0)
    x1, y1 = min(math.ceil(right + AROUND * side), width), min(math.ceil(bottom + AROUND * side), height)
    reach = MOVES * side
    return _Search(image[y0:y1, x0:x1], x0, y0, (left - reach, top - reach, right + reach, bottom + reach))


def _inside(search: _Search, region: Region) -> tuple[int, int, int, int]:
    (left, right), (top, bottom) = search.within(np.array(region[::2]), np.array(region[1::2]))
    return max(math.ceil(left), 0), max(math.ceil(top), 0), math.ceil(right), math.ceil(bottom)
