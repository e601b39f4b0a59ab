"""The third stage: turned back, a patch is compared with the target's pixel by pixel, wherever its middle is within a few.

Without turning back first, this correlation falls below its threshold where a target is turned by more than 10 deg.
"""

import math
from dataclasses import dataclass

import cv2
import numpy as np

from vcmvsp.agents.reconnaissance.recognition.polar import product
from vcmvsp.agents.reconnaissance.recognition.template import PATCH, Template, unit
from vcmvsp.cosim.types import Array

SHIFT = 4  # px of the patch, to all sides
STEP_RAD = 0.045
TURNS = STEP_RAD * np.arange(-2, 3)  # about the rotation that the second stage tells
SCALES = np.array([0.92, 0.96, 1.0, 1.04, 1.08])  # of the side
HOPELESS = 0.45  # correlation before turn and scale are refined: no refinement brings it to the threshold


@dataclass(frozen=True)
class MatchedPose:
    """Where a patch is and how it is turned."""

    u: float  # px
    v: float  # px
    angle: float  # rad, counter-clockwise
    side_px: float

    def shifted(self, across: float, down: float) -> "MatchedPose":
        """By so many px of the patch, along its own edges."""
        px = self.side_px / PATCH
        c, s = px * math.cos(self.angle), px * math.sin(self.angle)
        return MatchedPose(self.u + c * across + s * down, self.v - s * across + c * down, self.angle, self.side_px)


def match(image: Array, template: Template, pose: MatchedPose) -> tuple[float, MatchedPose]:
    """The correlation in [-1, 1] and where it is found: first the best shift, then turn and scale, then the shift again."""
    score, pose = _shift(image, template, pose)
    if score < HOPELESS:
        return score, pose
    return _shift(image, template, _turn(image, template, pose))


def _shift(image: Array, template: Template, pose: MatchedPose) -> tuple[float, MatchedPose]:
    """The best shift, to subpixels."""
    patch = _patches(image, pose, np.zeros(1), np.ones(1), PATCH + 2 * SHIFT)[0]
    scores = cv2.matchTemplate(patch, template.patch, cv2.TM_CCOEFF_NORMED)
    _, score, _, (u, v) = cv2.minMaxLoc(scores)
    return score, pose.shifted(u - SHIFT + vertex(scores[v], u), v - SHIFT + vertex(scores[:, u], v))


def _turn(image: Array, template: Template, pose: MatchedPose) -> MatchedPose:
    """The best angle, then scale, then angle again, since they are weakly coupled."""
    one = np.ones(len(TURNS))
    turn = _best(TURNS, _correlations(image, template, pose, TURNS, one))
    scale = _best(SCALES, _correlations(image, template, pose, turn * one, SCALES))
    turns = turn + TURNS[1:-1]
    turn = _best(turns, _correlations(image, template, pose, turns, scale * one[1:-1]))
    return MatchedPose(pose.u, pose.v, pose.angle + turn, pose.side_px * scale)


def _best(tried: Array, values: Array) -> float:
    """Maximum of a curve on an even grid."""
    at = int(values.argmax())
    return float(tried[at]) + float(tried[1] - tried[0]) * vertex(values, at)


def _correlations(image: Array, template: Template, pose: MatchedPose, turns: Array, scales: Array) -> Array:
    """Correlations of patches rotated and scaled relative to the pose, (n,)."""
    return product(unit(_patches(image, pose, turns, scales, PATCH)), template.unit[:, None])[:, 0]


def vertex(values: Array, at: int) -> float:
    """Where between the neighbours of its greatest value a curve is greatest, in steps from it; 0 at its ends."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, here, after = values[at - 1 : at + 2].tolist()
    bend = before - 2.0 * here + after
    return 0.5 * (before - after) / bend if bend < 0.0 else 0.0


def _patches(image: Array, pose: MatchedPose, turns: Array, scales: Array, size: int) -> Array:
    """Upright patches (n, size, size, 3) about the pose's centre, rotated and scaled relative to it."""
    step = pose.side_px / PATCH * scales
    c, s = step * np.cos(pose.angle + turns), step * np.sin(pose.angle + turns)
    along = np.arange(size) - 0.5 * (size - 1)
    c, s = c[:, None, None], s[:, None, None]
    across = pose.u + c * along + s * along[:, None]
    down = pose.v - s * along + c * along[:, None]
    shape = (len(turns) * size, size)
    maps = (across.astype(np.float32).reshape(shape), down.astype(np.float32).reshape(shape))
    sampled = cv2.remap(image, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sampled.reshape(len(turns), size, size, 3)
