"""The first stage: where the target's colours are, in about its shares (Toh 2012, 5.3: the most frequent first, then the next).

A back-projection with one colour ranks any large roof of that colour first; here a place scores for each of the target's hues
no more than the target has of it.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from vcmvsp.cosim.types import Array

SATURATION = 70  # of 255: paler pixels have no hue
BIN = 5  # of OpenCV's 180 hues
BESIDE = 2  # bins to either side count as the same hue
MOST_HUES = 4
LEAST_SHARE = 0.03  # of the target's pixels: what is rarer is not looked for
SIDE_PX = 15  # of the target in the picture searched; odd: it has a middle
THRESHOLD = 0.55
MOST_PEAKS = 16
APART = 0.6  # sides between two peaks
PART = 0.85  # of a peak: what is above it around it has the peak's place in its middle


@dataclass(frozen=True, eq=False)
class Hues:
    """The most frequent hues of a picture, and their shares of its pixels."""

    label: Array  # (256,) uint8: 0 none of them, else 1 + which, by OpenCV's hue
    shares: tuple[float, ...]

    @cached_property
    def tables(self) -> list[Array]:
        """For each hue a table (256,) uint8: 255 where a pixel has it, by OpenCV's hue."""
        return [np.where(self.label == i + 1, 255, 0).astype(np.uint8) for i in range(len(self.shares))]


def hues(picture: Array) -> Hues:
    """Of an RGB picture (n, m, 3); no shares where all of it is pale."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)
    hue = hsv[:, :, 0][hsv[:, :, 1] >= SATURATION].astype(int)
    bins = 180 // BIN
    left = np.bincount(hue // BIN, minlength=bins).astype(float)
    apart = np.abs(np.arange(bins)[:, None] - np.arange(bins))
    near = np.minimum(apart, bins - apart) <= BESIDE  # on the circle of hues
    chosen: list[int] = []
    while len(chosen) < MOST_HUES and left.max() > 0.0 and (near @ left).max() >= LEAST_SHARE * hsv[:, :, 0].size:
        chosen.append(int(left.argmax()))
        left[near[chosen[-1]]] = 0.0
    of_bin = np.zeros(bins, np.uint8)
    for number, one in reversed(list(enumerate(chosen, start=1))):  # the more frequent one keeps what lies between two
        of_bin[near[one]] = number
    label = np.zeros(256, np.uint8)
    label[:180] = of_bin[np.arange(180) // BIN]
    counts = np.bincount(label[hue], minlength=len(chosen) + 1)[1 : len(chosen) + 1]
    return Hues(label, tuple((counts / hsv[:, :, 0].size).tolist()))


def scores(hsv: Array, hues: Hues, side_px: int) -> Array:
    """How well the colours around each pixel are the target's, (h, w) uint8, 255: all of them; beyond the border is nothing."""
    total = np.zeros(hsv.shape[:2], np.uint8)
    _, pale = cv2.threshold(cv2.extractChannel(hsv, 1), SATURATION - 1, 255, cv2.THRESH_BINARY_INV)
    hue = cv2.bitwise_or(cv2.extractChannel(hsv, 0), pale)  # 255 is no hue
    for table, share in zip(hues.tables, hues.shares, strict=True):
        counts = cv2.boxFilter(cv2.LUT(hue, table), -1, (side_px, side_px), borderType=cv2.BORDER_CONSTANT)
        _, counted = cv2.threshold(counts, round(255 * share), 0, cv2.THRESH_TRUNC)  # no more than the target has
        cv2.add(total, counted, total)
    return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / sum(hues.shares)))


def peaks(score: Array, side_px: int, inside: tuple[int, int, int, int]) -> Array:
    """The best places, (n, 3): u, v in px and the score in [0, 1], best first; ``inside``: left, top, right, bottom."""
    reach = round(APART * side_px)
    highest = cv2.dilate(score, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    left, top, right, bottom = inside
    summit = np.zeros_like(score)
    summit[top:bottom, left:right] = np.where(score == highest, score, 0)[top:bottom, left:right]
    places: list[tuple[float, float, float]] = []
    while len(places) < MOST_PEAKS:
        _, best, _, (u, v) = cv2.minMaxLoc(summit)
        if best < THRESHOLD * 255:
            break
        places.append((*_middle(score, u, v, PART * best, side_px // 2), best / 255.0))
        cv2.circle(summit, (u, v), reach, 0.0, -1)
    return np.array(places).reshape(-1, 3)


def _middle(score: Array, u: int, v: int, least: float, reach: int) -> tuple[float, float]:
    """Centroid of the scores above ``least`` around a peak."""
    top, left = max(v - reach, 0), max(u - reach, 0)
    rows, columns = np.nonzero(score[top : v + reach + 1, left : u + reach + 1] >= least)
    return left + float(columns.mean()), top + float(rows.mean())
