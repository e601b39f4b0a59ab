"""Synthetic pictures of the ground from above with known content: targets and likenesses, roofs, roads, light, noise."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from vcmvsp.cosim.types import Array

WIDTH, HEIGHT, FOCAL_PX = 640, 480, 400.0
FINE = 2  # drawn this much finer than the picture, then averaged
CLEAR = 1.5  # sides between the middles of two objects: their diagonals do not touch

RED, BLUE, YELLOW, WHITE = (
    (200, 40, 40),
    (40, 60, 190),
    (235, 200, 30),
    (240, 240, 240),
)
Point = tuple[float, float]

DISTRACTORS = ("mirrored", "scrambled", "solid", "recoloured", "other")  # likenesses of a target


def glyph() -> Array:
    """A target, (128, 128, 3): two bars like an S, a disc and a strip; without rotational or mirror symmetry."""
    picture = np.full((128, 128, 3), RED, np.uint8)
    picture[12:116, 44:66] = BLUE
    picture[12:38, 44:116] = BLUE
    picture[90:116, 12:66] = BLUE
    cv2.circle(picture, (94, 84), 24, YELLOW, -1)
    picture[16:70, 14:30] = WHITE
    return picture


def other_glyph() -> Array:
    """Another picture with equal colours in similar shares."""
    picture = np.full((128, 128, 3), RED, np.uint8)
    picture[50:78, 10:118] = BLUE
    picture[10:118, 50:78] = BLUE
    cv2.fillConvexPoly(picture, np.array([(84, 84), (124, 84), (104, 124)]), YELLOW)
    picture[14:36, 14:28] = WHITE
    return picture


def mirrored(picture: Array) -> Array:
    """Mirror image of a picture."""
    return np.ascontiguousarray(picture[:, ::-1])


def scrambled(picture: Array, rng: np.random.Generator) -> Array:
    """Picture cut into 4 x 4 pieces in random order."""
    n = picture.shape[0] // 4
    pieces = picture.reshape(4, n, 4, n, 3).swapaxes(1, 2).reshape(16, n, n, 3)[rng.permutation(16)]
    joined: Array = pieces.reshape(4, 4, n, n, 3).swapaxes(1, 2).reshape(picture.shape)
    return np.ascontiguousarray(joined)


def solid(picture: Array) -> Array:
    """Picture in the most frequent colour of another one."""
    codes, counts = np.unique(picture.astype(np.int32) @ np.array([65536, 256, 1]), return_counts=True)
    code = int(codes[counts.argmax()])
    return np.full_like(picture, (code >> 16, code >> 8 & 255, code & 255))


def recoloured(picture: Array, rng: np.random.Generator) -> Array:
    """Picture with the same shapes in other hues."""
    hsv = cv2.cvtColor(picture, cv2.COLOR_RGB2HSV)
    hsv[:, :, 0] = (hsv[:, :, 0].astype(int) + rng.integers(35, 145)) % 180
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))


def likenesses(picture: Array, rng: np.random.Generator) -> list[Array]:
    """Likenesses of a target, in the order of `DISTRACTORS`."""
    return [mirrored(picture), scrambled(picture, rng), solid(picture), recoloured(picture, rng), other_glyph()]


def save(picture: Array, path: Path) -> None:
    """Write a picture to a PNG file."""
    path.write_bytes(cv2.imencode(".png", picture[:, :, ::-1])[1].tobytes())


@dataclass(frozen=True)
class Truth:
    """True place of a target in a picture."""

    name: str
    u: float  # px, of its middle
    v: float  # px
    angle: float = 0.0  # rad, counter-clockwise


@dataclass(frozen=True, eq=False)
class SyntheticPicture:
    """A picture taken straight down, and all targets with their middles in it."""

    image: Array  # (h, w, 3) uint8, RGB
    height_m: float
    focal_px: float
    truths: tuple[Truth, ...] = ()


@dataclass(frozen=True)
class SyntheticFrame:
    """A picture and its content."""

    seen: SyntheticPicture
    likenesses: tuple[tuple[str, float, float], ...]  # what it is, u, v: px

    @property
    def image(self) -> Array:
        """(480, 640, 3) RGB."""
        return self.seen.image

    @property
    def side_px(self) -> float:
        """Side of a target of 2 m in the picture, px."""
        return 2.0 * FOCAL_PX / self.seen.height_m


def frame(
    rng: np.random.Generator,
    height_m: float,
    targets: Sequence[tuple[str, Array]] = (("glyph", glyph()),),
    *,
    size_m: float = 2.0,
    distractors: bool = True,
    light: float | None = None,
    noise: float = 6.0,
    places: Sequence[Point] | None = None,
    angles: Sequence[float] | None = None,
) -> SyntheticFrame:
    """One picture with targets and five likenesses of the first, placed and rotated at random, wholly inside unless given.

    Places are px of the picture; angles rad, counter-clockwise.
    """
    side = size_m * FOCAL_PX / height_m
    canvas = _scene(rng, FOCAL_PX / height_m * FINE)
    decoys = likenesses(targets[0][1], rng) if distractors else []
    middles = list(places) if places is not None else _places(rng, len(targets), side, [])
    middles += _places(rng, len(decoys), side, middles)
    turns = list(angles) if angles is not None else rng.uniform(-math.pi, math.pi, len(targets)).tolist()
    turns += rng.uniform(-math.pi, math.pi, len(decoys)).tolist()
    for picture, middle, turn in zip([p for _, p in targets] + decoys, middles, turns, strict=True):
        _paste(canvas, picture, middle, turn, side)
    small = cv2.resize(canvas, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA).astype(np.float32)
    small = small * (rng.uniform(0.75, 1.2) if light is None else light) + noise * rng.standard_normal(small.shape, np.float32)
    image = np.clip(np.rint(small), 0, 255).astype(np.uint8)
    image.flags.writeable = False  # like pictures of cameras
    truths = tuple(Truth(name, *middles[i], turns[i]) for i, (name, _) in enumerate(targets))
    alike = tuple((name, *middles[len(targets) + i]) for i, name in enumerate(DISTRACTORS[: len(decoys)]))
    return SyntheticFrame(SyntheticPicture(image, height_m, FOCAL_PX, truths), alike)


def tilted(frame: SyntheticFrame, tilt: float, about: float) -> SyntheticFrame:
    """The scene from a camera tilted by an angle (rad) about an axis of its picture in the direction ``about`` (rad)."""
    K = np.array([[FOCAL_PX, 0.0, 0.5 * (WIDTH - 1)], [0.0, FOCAL_PX, 0.5 * (HEIGHT - 1)], [0.0, 0.0, 1.0]])
    turn, _ = cv2.Rodrigues(tilt * np.array([math.cos(about), math.sin(about), 0.0]))
    H = K @ turn @ np.linalg.inv(K)
    image = cv2.warpPerspective(frame.image, H, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderValue=(105, 105, 95))
    shifted = []
    for truth in frame.seen.truths:
        u, v, w = (H @ np.array([truth.u, truth.v, 1.0])).tolist()
        shifted.append(replace(truth, u=u / w, v=v / w))
    return replace(frame, seen=replace(frame.seen, image=image, truths=tuple(shifted)))


def _places(rng: np.random.Generator, n: int, side: float, occupied: Sequence[Point]) -> list[Point]:
    """Random places inside the picture, apart from each other; drawn anew until they fit."""
    edge = 0.75 * side
    for _ in range(1000):
        places: list[Point] = []
        tries = 200
        while len(places) < n and tries:
            tries -= 1
            at = (float(rng.uniform(edge, WIDTH - 1 - edge)), float(rng.uniform(edge, HEIGHT - 1 - edge)))
            if all(math.dist(at, place) > CLEAR * side for place in (*occupied, *places)):
                places.append(at)
        if len(places) == n:
            return places
    raise ValueError("the picture is too small for all shapes")


def _scene(rng: np.random.Generator, px_per_m: float) -> Array:
    """Textured ground, one or two roads, three to seven roofs, half of them coloured; (960, 1280, 3)."""
    height, width = HEIGHT * FINE, WIDTH * FINE
    base = np.array([(96, 104, 70), (120, 105, 80), (110, 110, 100)][rng.integers(3)], np.float32)
    texture = np.zeros((height, width), np.float32)
    for metres, strength in ((8.0, 14.0), (2.0, 10.0), (0.4, 8.0)):
        grid = (max(2, round(height / px_per_m / metres)), max(2, round(width / px_per_m / metres)))
        coarse = rng.normal(0.0, strength, grid).astype(np.float32)
        texture += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)
    canvas: Array = np.clip(base + texture[:, :, None], 0, 255).astype(np.uint8)
    for _ in range(rng.integers(1, 3)):
        middle = (rng.uniform(0, width), rng.uniform(0, height))
        _rectangle(canvas, middle, (3000.0, rng.uniform(3, 6) * px_per_m), rng.uniform(0, 180), (105, 105, 108))
    for i in range(rng.integers(3, 8)):
        if i % 2:
            pure = np.array([[[rng.integers(180), rng.integers(120, 230), rng.integers(120, 230)]]], np.uint8)
            colour = np.asarray(cv2.cvtColor(pure, cv2.COLOR_HSV2RGB))[0, 0].tolist()
        else:
            colour = (int(rng.integers(90, 180)),) * 3
        middle = (rng.uniform(0, width), rng.uniform(0, height))
        size = (rng.uniform(4, 12) * px_per_m, rng.uniform(4, 12) * px_per_m)
        _rectangle(canvas, middle, size, rng.uniform(0, 180), colour)
    return canvas


def _rectangle(canvas: Array, middle: Point, size: Point, degrees: float, colour: Sequence[int]) -> None:
    corners = cv2.boxPoints((middle, size, degrees))
    cv2.fillConvexPoly(canvas, np.rint(corners).astype(np.int32), tuple(colour), cv2.LINE_AA)


def _paste(canvas: Array, picture: Array, middle: Point, turn: float, side: float) -> None:
    """Paste a picture onto the canvas, rotated counter-clockwise, centred at a place of the small picture."""
    n = max(8, round(side * FINE))  # brought to about its size first: no aliasing
    small = cv2.resize(picture, (n, n), interpolation=cv2.INTER_AREA)
    scale = side * FINE / n
    c, s = scale * math.cos(turn), scale * math.sin(turn)
    reach = math.ceil(0.75 * side * FINE)  # more than half a diagonal
    (left, right), (top, bottom) = ((math.floor(FINE * value) - reach, math.floor(FINE * value) + reach) for value in middle)
    left, top = max(left, 0), max(top, 0)
    part = canvas[top : max(bottom, 0), left : max(right, 0)]
    if not part.size:
        return
    # middles of pixels are whole numbers, in the small picture and on the canvas
    at = np.array([FINE * (middle[0] + 0.5) - 0.5 - left, FINE * (middle[1] + 0.5) - 0.5 - top])
    A = np.array([[c, s], [-s, c]])  # v points down: counter-clockwise as one looks at it
    M = np.column_stack([A, at - A @ np.array([0.5 * (n - 1)] * 2)])
    size = (part.shape[1], part.shape[0])
    cover = cv2.warpAffine(np.ones((n, n), np.float32), M, size, borderValue=0.0)[:, :, None]
    laid = cv2.warpAffine(small, M, size, borderMode=cv2.BORDER_REPLICATE)
    np.copyto(part, np.rint(part * (1.0 - cover) + laid * cover).astype(np.uint8))
