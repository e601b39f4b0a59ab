"""Scores of the stages at given places of a picture, without thresholds: for figures and diagnosis."""

import math
from typing import NamedTuple

import cv2
import numpy as np

from vcmvsp.agents.reconnaissance.recognition.stages import (
    FULL,
    PATCH,
    SHIFT,
    SIDE_PX,
    Hues,
    MatchedPose,
    TargetPicture,
    Template,
    colour_peaks,
    colour_scores,
    match,
    product,
    rotation,
)
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array

# sides off the given place at which a patch is tried, to the right and down
TRIES = np.array([(0.045 * i, 0.045 * j) for j in range(-3, 4) for i in range(-3, 4)])


class Scores(NamedTuple):
    """Scores of one place in a picture."""

    colour: float  # in [0, 1]
    rings: float  # cosine of the second stage
    angle: float  # rad, that it estimates
    match: float  # correlation of the third stage after turning back by that angle
    upright: float  # best correlation without turning back, for middles within a few pixels
    fixed: float  # correlation after turning back, at exactly the given place


class ColourMap(NamedTuple):
    """Result of the first stage for a picture."""

    score: Array  # (h, w) uint8, 255: all of the target's colours are present
    scale: float  # so many of its pixels per pixel of the picture, about
    peaks: Array  # (n, 3): u, v px of the picture and score in [0, 1], best first


def colour_map(target: TargetPicture, image: Array, height_m: float, focal_px: float, *, most_hues: int = 4) -> ColourMap:
    """The score of a picture (h, w, 3) by the target's most frequent hues, so many of them."""
    side = target.size_m * focal_px / height_m
    scale = min(1.0, SIDE_PX / side)
    small = _resized(image, scale)
    window = round(0.5 * (side * scale - 1.0)) * 2 + 1
    hues = target.template(round(side)).hues
    label = np.where(hues.label <= most_hues, hues.label, 0).astype(np.uint8)
    score = colour_scores(cv2.cvtColor(small, cv2.COLOR_RGB2HSV), Hues(label, hues.shares[:most_hues]), window)
    places = colour_peaks(score, window, (0, 0, score.shape[1], score.shape[0]))
    exact = np.array([small.shape[1] / image.shape[1], small.shape[0] / image.shape[0]])
    places[:, :2] = (places[:, :2] + 0.5) / exact - 0.5  # the edges of pixels coincide, not their middles
    return ColourMap(score, scale, places)


def inspect(target: TargetPicture, image: Array, height_m: float, focal_px: float, place: tuple[float, float]) -> Scores:
    """Scores of all stages at a place, px of a picture (h, w, 3); the middle is searched nearby."""
    side = target.size_m * focal_px / height_m
    template, scale = target.template(round(side)), min(1.0, PATCH / side)
    sharp = _resized(image, scale)
    u, v = ((value + 0.5) * scale - 0.5 for value in place)
    us, vs, px = u + side * scale * TRIES[:, 0], v + side * scale * TRIES[:, 1], np.full(len(TRIES), side * scale)
    spectra = FULL.spectra(sharp, us, vs, px)
    cosines = product(FULL.signatures(spectra).unit, template.full.unit.T)[:, 0]
    best = int(cosines.argmax())
    angle = wrap(rotation(spectra[:, best], template.full.spectra[:, 0]))
    middle = float(us[best]), float(vs[best])
    turned, _ = match(sharp, template, MatchedPose(*middle, angle, side * scale))
    upright = _correlation(sharp, template, MatchedPose(*middle, 0.0, side * scale), SHIFT)
    fixed = _correlation(sharp, template, MatchedPose(u, v, angle, side * scale), 0)
    coloured = colour_map(target, image, height_m, focal_px)
    row, column = (int(np.clip(round((value + 0.5) * coloured.scale - 0.5), 0, None)) for value in reversed(place))
    near = coloured.score[max(row - 2, 0) : row + 3, max(column - 2, 0) : column + 3]
    return Scores(float(near.max()) / 255.0, float(cosines[best]), angle, turned, upright, fixed)


def _correlation(image: Array, template: Template, pose: MatchedPose, shift: int) -> float:
    """Best correlation of the template with the rotated patch within so many pixels of shift."""
    size, px = PATCH + 2 * shift, pose.side_px / PATCH
    c, s = px * math.cos(pose.angle), px * math.sin(pose.angle)
    A = np.array([[c, s], [-s, c]])
    M = np.column_stack([A, np.array([pose.u, pose.v]) - A @ np.array([0.5 * (size - 1)] * 2)])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    patch = cv2.warpAffine(image, M, (size, size), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return float(cv2.matchTemplate(patch, template.patch, cv2.TM_CCOEFF_NORMED).max())


def _resized(image: Array, scale: float) -> Array:
    if scale == 1.0:
        return image
    size = [max(1, round(scale * n)) for n in (image.shape[1], image.shape[0])]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if scale < 0.5 else cv2.INTER_LINEAR))
