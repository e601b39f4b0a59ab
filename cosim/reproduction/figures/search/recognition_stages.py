"""Figures 46 and 47: the stages of recognition in synthetic pictures of the ground (Toh 2012, 5.3)."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np

from vcmvsp.cosim.assembly.parts.recognition import ground, inspection
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Panel, Photo
from vcmvsp.cosim.reproduction.figures.search.synthetic_pictures import KINDS, SIZE_M, box, synthetic_frame, target
from vcmvsp.cosim.reproduction.row import Row, absolute, at_least, at_most, relative
from vcmvsp.cosim.reproduction.runner import Runner
from vcmvsp.cosim.types import Array

T = TypeVar("T")
HEIGHTS = (10.0, 20.0, 30.0, 40.0)  # m
FRAMES = 25  # at each height
SHOWN = (20.0, 4)  # height and number of the picture that is shown
HUES = (1, 2, 3, 4)  # number of most frequent hues that count
PEAKS = 16  # at most
RINGS, MATCH = 0.88, 0.75  # thresholds of the stages
TURNS_DEG = tuple(range(0, 181, 5))
SHIFTS_PX = tuple(range(8))  # of the patch, which has 48 a side
# of an independent implementation: minimum of targets in stages 2 and 3, maximum of likenesses in 3, the mirrored in 2
TARGET_RINGS, TARGET_MATCH, ALIKE_MATCH, MIRRORED_RINGS = 0.97, 0.96, 0.65, 0.99
UPRIGHT = {0: 0.985, 20: 0.52}  # degrees: correlation without rotation; below 0.75 beyond 10
COLORS = dict(zip(KINDS, (2, 1, 3, 4, 5, 6), strict=True))


def fig_46(runner: Runner, frames: int = FRAMES) -> Figure:
    """Figure 46: score maps of the target's colours, by the most frequent hue alone and by up to four hues."""
    ranks = np.concatenate(_by_height(runner, _ranks, frames))
    shares = ground.glyph().reshape(-1, 3)
    counted = np.unique(shares, axis=0, return_counts=True)[1] / len(shares)
    hues = target().template(48).hues.shares
    middle = {hues: float(np.median(ranks[:, i])) for i, hues in enumerate(HUES)}
    rows = [
        relative("most frequent colour, in the blurred template: share", counted.max(), hues[0], 0.15),
        relative("next colour, in the blurred template: share", np.sort(counted)[-2], hues[1], 0.15),
        absolute("share of the targets that have a peak of the score", 1.0, float((ranks[:, -1] <= PEAKS).mean()), 0.03),
        at_most("median rank of the target among the peaks, four colours", 3.0, middle[4]),
        at_least("median rank of the target, one colour over four", 1.5, middle[1] / middle[4]),
    ]
    panels = [*_maps(), _reached(ranks), _hues(hues)]
    return Figure("Fig. 46: first stage: the target's colours in about its shares", panels, rows, columns=3)


def _ranks(height_m: float, numbers: Sequence[int]) -> Array:
    """Rank of the target in the list of peaks, from 1, (pictures, numbers of hues); inf if absent."""
    ranks = np.full((len(numbers), len(HUES)), np.inf)
    for row, number in enumerate(numbers):
        frame = synthetic_frame(height_m, number)
        (truth,) = frame.seen.truths
        for column, hues in enumerate(HUES):
            peaks = inspection.colour_map(target(), frame.image, height_m, frame.seen.focal_px, most_hues=hues).peaks
            near = np.flatnonzero(np.hypot(peaks[:, 0] - truth.u, peaks[:, 1] - truth.v) < 0.5 * frame.side_px)
            ranks[row, column] = near[0] + 1 if near.size else np.inf
    return ranks


def _maps() -> list[Panel]:
    height_m, number = SHOWN
    frame = synthetic_frame(height_m, number)
    (truth,) = frame.seen.truths
    target_box = box(truth.u, truth.v, 1.5 * frame.side_px, 0.0, "target", 2)
    alike = [box(u, v, 1.5 * frame.side_px, 0.0, "likeness", 6) for _, u, v in frame.likenesses]
    axes = "u [px]", "v [px]"
    panels = [Panel(f"The picture, from {height_m:g} m", *axes, [target_box, *alike], photo=Photo(frame.image))]
    for hues, name in ((1, "the most frequent colour"), (4, "all colours")):
        score_map = inspection.colour_map(target(), frame.image, height_m, frame.seen.focal_px, most_hues=hues)
        peaks = Curve(score_map.peaks[:, 0], score_map.peaks[:, 1], f"{len(score_map.peaks)} peaks", 1, "hollow")
        photo = Photo(_enlarged(score_map.score, frame.image.shape[:2]))
        panels.append(Panel(f"Score by {name}", *axes, [target_box, peaks], photo=photo))
    return panels


def _enlarged(score: Array, shape: Sequence[int]) -> Array:
    """A score map at the size of the picture: white 0, black all of the target's colours."""
    rows, columns = ((np.arange(n) * m // n) for n, m in zip(shape, score.shape, strict=True))
    grey = 255 - score[np.ix_(rows, columns)]
    return np.repeat(grey[:, :, None], 3, axis=2)


def _reached(ranks: Array) -> Panel:
    x = np.arange(1, PEAKS + 1)
    curves = [
        Curve(x, (ranks[:, i, None] <= x).mean(axis=0), f"{hues} colour{'s' * (hues > 1)}", 1 + i, "both")
        for i, hues in enumerate(HUES)
    ]
    return Panel("Targets among the best peaks", "number of peaks", "share of the targets", curves, y_limits=(0.0, 1.05))


def _hues(shares: Sequence[float]) -> Panel:
    x = np.arange(1, len(shares) + 1)
    curve = Curve(x, np.array(shares), "", 1, "both")
    return Panel("The target's colours", "from the most frequent one", "share of the target", [curve], y_limits=(0.0, 0.7))


class PlaceScores(NamedTuple):
    """Scores of the stages at positions in a picture."""

    scores: dict[str, inspection.Scores]  # by kind
    angle: float  # rad, of the target


def fig_47(runner: Runner, frames: int = FRAMES) -> Figure:
    """Figure 47: effect of rotation on the stages; scores of targets and of their likenesses; estimated angles."""
    judgements = [judgement for each in _by_height(runner, _judged, frames) for judgement in each]
    jobs = [partial(_single_target, at) for at in TURNS_DEG]
    jobs += [partial(_single_target, 30.0, off) for off in SHIFTS_PX]
    moved = runner(jobs)
    turned, shifted = moved[: len(TURNS_DEG)], moved[len(TURNS_DEG) :]
    rings: dict[str, Array] = {}
    match: dict[str, Array] = {}
    for kind in KINDS:
        rings[kind] = np.array([each.scores[kind].rings for each in judgements])
        match[kind] = np.array([each.scores[kind].match for each in judgements])
    errors = np.degrees([abs(wrap(each.scores["target"].angle - each.angle)) for each in judgements])
    rows: list[Row] = [
        absolute("target, stage 2: least score", 1.0, rings["target"].min(), 1.0 - TARGET_RINGS),
        absolute("target, stage 3: least score", 1.0, match["target"].min(), 1.0 - TARGET_MATCH),
    ]
    rows += [at_most(f"{kind}, stage 3: largest score", ALIKE_MATCH, match[kind].max()) for kind in KINDS[1:]]
    rows += [
        absolute("mirrored, stage 2: median score", MIRRORED_RINGS, float(np.median(rings["mirrored"])), 0.01),
        at_most("all other likenesses, stage 2: largest score", RINGS, max(rings[kind].max() for kind in KINDS[2:])),
        absolute("angle that stage 2 estimates: median error, deg", 0.0, float(np.median(errors)), 1.0),
    ]
    upright = {at: each.upright for at, each in zip(TURNS_DEG, turned, strict=True)}
    for at, must in UPRIGHT.items():
        rows.append(absolute(f"turned by {at} deg, not turned back: correlation", must, upright[at], 0.08))
    rows.append(at_most("turned by 15 deg, not turned back: correlation", MATCH, upright[15]))
    for name, scores in (("turned by any angle, turned back", turned), ("told up to 7 px off", shifted)):
        rows.append(absolute(f"{name}: least correlation", 1.0, min(each.match for each in scores), 1.0 - TARGET_MATCH))
    by_turn = {"rings": "stage 2", "match": "stage 3, turned back", "upright": "stage 3, not turned back"}
    by_shift = {"rings": "stage 2", "match": "stage 3", "fixed": "correlation at the told place"}
    panels = [
        _likenesses(),
        _moved("A turned target", "turned by [deg]", TURNS_DEG, turned, by_turn),
        _moved("A shifted target", "told place off by [px of 48]", SHIFTS_PX, shifted, by_shift),
        _scores(rings, match),
        *_angles(judgements, errors),
    ]
    return Figure("Fig. 47: later stages: what turning does not change, then correlation", panels, rows, columns=3)


def _judged(height_m: float, numbers: Sequence[int]) -> list[PlaceScores]:
    peaks = []
    for number in numbers:
        frame = synthetic_frame(height_m, number)
        (truth,) = frame.seen.truths
        places = {"target": (truth.u, truth.v), **{name: (u, v) for name, u, v in frame.likenesses}}
        picture = frame.image, height_m, frame.seen.focal_px
        scores = {kind: inspection.inspect(target(), *picture, at) for kind, at in places.items()}
        peaks.append(PlaceScores(scores, truth.angle))
    return peaks


def _single_target(degrees: float, off_px: float = 0.0) -> inspection.Scores:
    """Scores of a single target, 40 px a side, at an angle; ``off_px`` is the position error in px of the patch."""
    place = 319.5, 239.5
    frame = ground.frame(
        np.random.default_rng(5), 20.0, places=[place], angles=[math.radians(degrees)], distractors=False, light=1.0
    )
    estimates = place[0] + off_px * frame.side_px / 48.0, place[1]
    return inspection.inspect(target(), frame.image, 20.0, frame.seen.focal_px, estimates)


def _likenesses() -> Panel:
    pictures = [ground.glyph(), *ground.likenesses(ground.glyph(), np.random.default_rng(1))]
    edge = np.full((pictures[0].shape[0], 12, 3), 255, np.uint8)
    framed = [np.hstack([each, edge]) for each in pictures]
    upper, lower = np.hstack(framed[:3]), np.hstack(framed[3:])
    between = np.full((24, upper.shape[1], 3), 255, np.uint8)
    pixels = np.vstack([upper, between, lower])
    first = box(63.5, 63.5, 132.0, 0.0, "", 0)  # a legend would hide a target
    return Panel(f"A target of {SIZE_M:g} m, framed, and its likenesses", "u [px]", "v [px]", [first], photo=Photo(pixels))


def _moved(
    title: str, by: str, amounts: Sequence[int], scores: Sequence[inspection.Scores], labels: Mapping[str, str]
) -> Panel:
    x, curves = np.array(amounts, float), []
    for color, (name, label) in enumerate(labels.items(), 1):
        curves.append(Curve(x, np.array([getattr(each, name) for each in scores]), label, color))
    return Panel(title, by, "score", curves, levels={"threshold of stage 3": MATCH})


def _scores(rings: dict[str, Array], match: dict[str, Array]) -> Panel:
    curves = [Curve(rings[kind], match[kind], kind, COLORS[kind], "markers") for kind in KINDS]
    curves.append(Curve(np.array([RINGS, RINGS]), np.array([-0.3, 1.0]), "thresholds", 0, "dotted"))
    curves.append(Curve(np.array([0.1, 1.0]), np.array([MATCH, MATCH]), "", 0, "dotted"))
    return Panel("Scores of targets and likenesses", "score of stage 2", "score of stage 3", curves)


def _angles(judgements: Sequence[PlaceScores], errors: Array) -> list[Panel]:
    truth = np.degrees([each.angle for each in judgements])
    angles = np.degrees([each.scores["target"].angle for each in judgements])
    ends = np.array([-180.0, 180.0])
    curves = [Curve(truth, angles, "estimated", 2, "markers"), Curve(ends, ends, "", 0, "thin")]
    share = np.arange(1, len(errors) + 1) / len(errors)
    return [
        Panel("The angle of the target", "true [deg]", "estimated [deg]", curves),
        Panel("Error of the angle", "error [deg]", "share of the targets", [Curve(np.sort(errors), share, "", 1)]),
    ]


def _by_height(runner: Runner, work: Callable[[float, Sequence[int]], T], frames: int) -> list[T]:
    return runner([partial(work, height, range(frames)) for height in HEIGHTS])
