"""The three stages of recognition, and pictures of targets at the scale of a height.

1. Where the target's colours are, in about its shares (Toh 2012, 5.3: the most frequent first, then the next). A
   back-projection with one colour ranks any large roof of that colour first; here a place scores for each of the target's
   hues no more than the target has of it.
2. What does not change when the picture is turned. A patch is sampled on rings around its middle. Turned by phi, each ring is
   shifted: the magnitudes of its Fourier coefficients stay, their phases tell phi. The harmonic 0 keeps its sign. Magnitudes
   cannot tell a picture from its mirror image. All patches of a call are sampled by one `cv2.remap` and transformed by one
   product of matrices.
3. Turned back, a patch is compared with the target's pixel by pixel, wherever its middle is within a few. Without turning back
   first, this correlation falls below its threshold where a target is turned by more than 10 deg.
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import cv2
import numpy as np

from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Array
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.pictures import decoded

SATURATION = 70  # of 255: pixels below it have no hue
BIN = 5  # of OpenCV's 180 hues
BESIDE = 2  # bins to either side count as the same hue
MOST_HUES = 4
LEAST_SHARE = 0.03  # of the target's pixels: rarer hues are ignored
SIDE_PX = 15  # of the target in the picture searched; odd: it has a middle
THRESHOLD = 0.55
MOST_PEAKS = 16
APART = 0.6  # sides between two peaks
PART = 0.85  # of a peak: its place is the middle of the scores above this share


@dataclass(frozen=True, eq=False)
class Hues:
    """The most frequent hues of a picture, and their shares of its pixels."""

    label: Array  # (256,) uint8: 0 none of them, else 1 + which, by OpenCV's hue
    shares: tuple[float, ...]

    @cached_property
    def tables(self) -> list[Array]:
        """Table for each hue, (256,) uint8: 255 where a pixel has it, by OpenCV's hue."""
        return [np.where(self.label == i + 1, 255, 0).astype(np.uint8) for i in range(len(self.shares))]


def hues(picture: Array) -> Hues:
    """Most frequent hues of an RGB picture (n, m, 3); no shares if all pixels are pale."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)
    hue = hsv[:, :, 0][hsv[:, :, 1] >= SATURATION].astype(int)
    bins = 180 // BIN
    histogram = np.bincount(hue // BIN, minlength=bins).astype(float)
    apart = np.abs(np.arange(bins)[:, None] - np.arange(bins))
    near = np.minimum(apart, bins - apart) <= BESIDE  # on the circle of hues
    chosen: list[int] = []
    while len(chosen) < MOST_HUES and histogram.max() > 0.0 and (near @ histogram).max() >= LEAST_SHARE * hsv[:, :, 0].size:
        chosen.append(int(histogram.argmax()))
        histogram[near[chosen[-1]]] = 0.0
    of_bin = np.zeros(bins, np.uint8)
    for number, peak in reversed(list(enumerate(chosen, start=1))):  # the more frequent one gets the bins between two
        of_bin[near[peak]] = number
    label = np.zeros(256, np.uint8)
    label[:180] = of_bin[np.arange(180) // BIN]
    counts = np.bincount(label[hue], minlength=len(chosen) + 1)[1 : len(chosen) + 1]
    return Hues(label, tuple((counts / hsv[:, :, 0].size).tolist()))


def colour_scores(hsv: Array, hues: Hues, side_px: int) -> Array:
    """Score of the target's colours around each pixel, (h, w) uint8, 255: all of them; beyond the border there are none."""
    total = np.zeros(hsv.shape[:2], np.uint8)
    _, pale = cv2.threshold(cv2.extractChannel(hsv, 1), SATURATION - 1, 255, cv2.THRESH_BINARY_INV)
    hue = cv2.bitwise_or(cv2.extractChannel(hsv, 0), pale)  # 255 is no hue
    for table, share in zip(hues.tables, hues.shares, strict=True):
        counts = cv2.boxFilter(cv2.LUT(hue, table), -1, (side_px, side_px), borderType=cv2.BORDER_CONSTANT)
        _, counted = cv2.threshold(counts, round(255 * share), 0, cv2.THRESH_TRUNC)  # no more than the target has
        cv2.add(total, counted, total)
    return np.asarray(cv2.convertScaleAbs(total, alpha=1.0 / sum(hues.shares)))


def colour_peaks(score: Array, side_px: int, inside: tuple[int, int, int, int]) -> Array:
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
    top, left = max(v - reach, 0), max(u - reach, 0)
    rows, columns = np.nonzero(score[top : v + reach + 1, left : u + reach + 1] >= least)
    return left + float(columns.mean()), top + float(rows.mean())


HARMONICS = 9  # 0 to 8
TURNS = 72  # rotations are searched in steps of 5 deg


@dataclass(frozen=True, eq=False)
class Signature:
    """Rotation-invariant signatures of n patches."""

    spectra: Array  # (9, n, m) complex64, m: radii x channels; weighted by the square root of the radius
    unit: Array  # (n, 9 m) float32: the magnitudes, a row of length 1 for a patch


class Rings:
    """Places around the middle of a patch, as parts of its side."""

    def __init__(self, angles: int, radii: int) -> None:
        theta = math.tau / angles * np.arange(angles)[:, None]
        radius = 0.5 / radii * (np.arange(radii) + 0.5)
        self._u = (radius * np.cos(theta)).astype(np.float32)[:, None, :]
        self._v = (-radius * np.sin(theta)).astype(np.float32)[:, None, :]  # v points down; theta to the left
        phase = np.arange(HARMONICS)[:, None] * theta[:, 0]
        self._transform = np.vstack([np.cos(phase), -np.sin(phase)]).astype(np.float32) / angles
        self._weight = np.repeat(np.sqrt(radius), 3).astype(np.float32)
        self._angles, self._radii = angles, radii

    def spectra(self, image: Array, u: Array, v: Array, side_px: Array) -> Array:
        """Spectra of patches with middles at u, v (n,) px of an RGB picture, of sides (n,) px: (9, n, 3 radii) complex64."""
        n = len(u)
        u, v, side = (values.astype(np.float32)[None, :, None] for values in (u, v, side_px))
        across, down = (u + side * self._u).reshape(self._angles, -1), (v + side * self._v).reshape(self._angles, -1)
        samples = cv2.remap(image, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        parts = product(self._transform, samples.reshape(self._angles, -1).astype(np.float32))
        parts = parts.reshape(2, HARMONICS, n, self._radii, 3)
        parts[0, 0] -= parts[0, 0].mean(axis=1, keepdims=True)  # channel means
        return (parts[0] + 1j * parts[1]).reshape(HARMONICS, n, -1) * self._weight

    def signatures(self, spectra: Array) -> Signature:
        """Signatures of patches from their spectra."""
        size = np.abs(spectra)
        size[0] = spectra[0].real
        rows = np.ascontiguousarray(size.swapaxes(0, 1)).reshape(size.shape[1], -1)
        rows /= np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), 1e-6)[:, None]
        return Signature(spectra, rows)


def product(a: Array, b: Array) -> Array:
    """Product of two matrices by one thread: the same sums on any number of cores."""
    return np.einsum("ij,jk->ik", a, b)


COARSE = Rings(36, 12)  # to find the middle
FULL = Rings(72, 24)  # to judge

_BACK = np.exp(1j * np.outer(math.tau / TURNS * np.arange(TURNS), np.arange(HARMONICS))).astype(np.complex64)


def rotation(spectrum: Array, template: Array) -> float:
    """Rotation of a patch, rad in [-pi, pi), counter-clockwise: the maximum of the circular cross-correlation.

    Both are spectra (9, m); a parabola interpolates between the steps of 5 deg.
    """
    curve = product(_BACK, np.einsum("km,km->k", spectrum, template.conj())[:, None])[:, 0].real
    best = int(curve.argmax())
    before, peak, after = curve[best - 1], curve[best], curve[(best + 1) % TURNS]
    bend = before - 2.0 * peak + after
    shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
    return (math.tau / TURNS * (best + float(shift)) + math.pi) % math.tau - math.pi


PATCH = 48  # px: pictures are compared at this size
CAMERA_BLUR_PX = 0.8  # standard deviation of the area that a pixel of the camera averages, px of its picture
SMALLEST_PX = 16  # least side of a picture of a target


@dataclass(frozen=True, eq=False)
class TargetPicture:
    """A square picture of a target from above, and its true size.

    A target that is nearly its own mirror image cannot be told from it; one with rotational symmetry has several angles.
    """

    name: str
    picture: Array  # (n, n, 3) uint8, RGB; its upper edge is where the angle of a detection points
    size_m: float  # of a side

    def __post_init__(self) -> None:
        shape = self.picture.shape
        if self.picture.dtype != np.uint8 or len(shape) != 3 or shape[2] != 3:
            raise ScenarioError(
                f"a picture must be an array (n, n, 3) of uint8, RGB, not {shape} of {self.picture.dtype}", key="picture"
            )
        if shape[0] != shape[1] or shape[0] < SMALLEST_PX:
            rule = f"the picture of {self.name} must be square, {SMALLEST_PX} pixels or more a side"
            raise ScenarioError(f"{rule}, not {shape[1]} x {shape[0]}", key="picture")
        if not 0.0 < self.size_m < float("inf"):
            raise ScenarioError(f"the side of {self.name} must be greater than 0 m, not {self.size_m}", key="size_m")
        if not self.template(PATCH).hues.shares:
            raise ScenarioError(f"the picture of {self.name} is grey; detection needs colours", key="picture")

    @classmethod
    def load(cls, name: str, path: Path | str, size_m: float) -> "TargetPicture":
        """Read the picture from a file (PNG, JPEG, ...)."""
        try:
            read = decoded(limits.read_bytes(Path(path), limits.FILE_BYTES), cv2.IMREAD_COLOR_RGB)
        except (OSError, ValueError) as error:
            raise ScenarioError(f"cannot read the picture of {name}: {error}", key="picture") from error
        if read is None:
            raise ScenarioError(f"{path} is not a picture that can be read{limits.PICTURE}", key="picture")
        return cls(name, read, size_m)

    def template(self, side_px: int) -> "Template":
        """The picture scaled to a side of so many pixels; cached."""
        return _template(self, side_px)


@dataclass(frozen=True, eq=False)
class Template:
    """A target at one scale, prepared for the three stages."""

    patch: Array  # (48, 48, 3) uint8
    hues: Hues
    coarse: Signature
    full: Signature
    unit: Array  # (6912,) float32: the patch less its channel means, of length 1


@lru_cache(maxsize=64)
def _template(target: TargetPicture, side_px: int) -> Template:
    patch = cv2.resize(target.picture, (PATCH, PATCH), interpolation=cv2.INTER_AREA)
    sigma = CAMERA_BLUR_PX * PATCH / side_px
    patch = cv2.GaussianBlur(patch, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)
    middle = 0.5 * (PATCH - 1)
    at, side = np.array([middle]), np.array([float(PATCH)])
    return Template(
        patch=patch,
        hues=hues(patch),
        coarse=COARSE.signatures(COARSE.spectra(patch, at, at, side)),
        full=FULL.signatures(FULL.spectra(patch, at, at, side)),
        unit=unit(patch[None])[0],
    )


def unit(patches: Array) -> Array:
    """Patches (n, 48, 48, 3) as rows (n, 6912) less their channel means, each of length 1: their products are correlations."""
    flat = patches.astype(np.float32).reshape(len(patches), -1, 3)
    flat -= flat.mean(axis=1, keepdims=True)
    rows = flat.reshape(len(patches), -1)
    rows /= np.maximum(np.sqrt(np.einsum("ij,ij->i", rows, rows)), 1e-6)[:, None]
    return rows


SHIFT = 4  # px of the patch, to all sides
STEP_RAD = 0.045
TRIED_TURNS = STEP_RAD * np.arange(-2, 3)  # around the rotation from the second stage
SCALES = np.array([0.92, 0.96, 1.0, 1.04, 1.08])  # of the side
HOPELESS = 0.45  # correlation before turn and scale are refined: no refinement brings it to the threshold


@dataclass(frozen=True)
class MatchedPose:
    """Place, rotation and scale of a patch."""

    u: float  # px
    v: float  # px
    angle: float  # rad, counter-clockwise
    side_px: float

    def shifted(self, across: float, down: float) -> "MatchedPose":
        """The pose shifted by px of the patch, along its own edges."""
        px = self.side_px / PATCH
        c, s = px * math.cos(self.angle), px * math.sin(self.angle)
        return MatchedPose(self.u + c * across + s * down, self.v - s * across + c * down, self.angle, self.side_px)


def match(image: Array, template: Template, pose: MatchedPose) -> tuple[float, MatchedPose]:
    """The correlation in [-1, 1] and its pose: first the best shift, then rotation and scale, then the shift again."""
    score, pose = _shift(image, template, pose)
    if score < HOPELESS:
        return score, pose
    return _shift(image, template, _turn(image, template, pose))


def _shift(image: Array, template: Template, pose: MatchedPose) -> tuple[float, MatchedPose]:
    patch = _patches(image, pose, np.zeros(1), np.ones(1), PATCH + 2 * SHIFT)[0]
    scores = cv2.matchTemplate(patch, template.patch, cv2.TM_CCOEFF_NORMED)
    _, score, _, (u, v) = cv2.minMaxLoc(scores)
    return score, pose.shifted(u - SHIFT + vertex(scores[v], u), v - SHIFT + vertex(scores[:, u], v))


def _turn(image: Array, template: Template, pose: MatchedPose) -> MatchedPose:
    """The best angle, then scale, then angle again, since they are weakly coupled."""
    ones = np.ones(len(TRIED_TURNS))
    turn = _best(TRIED_TURNS, _correlations(image, template, pose, TRIED_TURNS, ones))
    scale = _best(SCALES, _correlations(image, template, pose, turn * ones, SCALES))
    turns = turn + TRIED_TURNS[1:-1]
    turn = _best(turns, _correlations(image, template, pose, turns, scale * ones[1:-1]))
    return MatchedPose(pose.u, pose.v, pose.angle + turn, pose.side_px * scale)


def _best(tried: Array, values: Array) -> float:
    at = int(values.argmax())
    return float(tried[at]) + float(tried[1] - tried[0]) * vertex(values, at)


def _correlations(image: Array, template: Template, pose: MatchedPose, turns: Array, scales: Array) -> Array:
    return product(unit(_patches(image, pose, turns, scales, PATCH)), template.unit[:, None])[:, 0]


def vertex(values: Array, at: int) -> float:
    """Vertex of a curve next to its greatest value, in steps from it; 0 at its ends."""
    if not 0 < at < len(values) - 1:
        return 0.0
    before, peak, after = values[at - 1 : at + 2].tolist()
    bend = before - 2.0 * peak + after
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
