"""Targets in pictures of the ground: detection among lookalikes, position and angle."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import pytest

from vcmvsp.agents.reconnaissance.recognition import ground
from vcmvsp.agents.reconnaissance.recognition.detector import Detection, Detector, Region
from vcmvsp.agents.reconnaissance.recognition.ground import FOCAL_PX, YELLOW, SyntheticFrame, frame, glyph, tilted
from vcmvsp.agents.reconnaissance.recognition.stages import TargetPicture
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array

pytestmark = pytest.mark.slow

HEIGHTS = (10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0)
GLYPH = TargetPicture("glyph", glyph(), 2.0)


def second_glyph() -> Array:
    """A target in other colours: a magenta arrow on green."""
    magenta = (190, 40, 170)
    picture = np.full((128, 128, 3), (30, 150, 60), np.uint8)
    picture[52:78, 10:70] = magenta
    cv2.fillConvexPoly(picture, np.array([(66, 24), (66, 106), (118, 65)]), magenta)
    picture[96:118, 12:60] = YELLOW
    return picture


@dataclass
class Tally:
    """Results of a detector on frames with one target each."""

    found: int = 0
    missed: int = 0
    false: list[str] = field(default_factory=list)
    angles: list[float] = field(default_factory=list)  # errors, rad
    places: list[float] = field(default_factory=list)  # errors, sides

    def add(self, made: SyntheticFrame, detections: list[Detection]) -> None:
        (truth,) = made.seen.truths
        right = [one for one in detections if math.dist(one.centre_px, (truth.u, truth.v)) < 0.25 * made.side_px][:1]
        self.found, self.missed = self.found + len(right), self.missed + 1 - len(right)
        self.angles += [abs(wrap(one.angle - truth.angle)) for one in right]
        self.places += [math.dist(one.centre_px, (truth.u, truth.v)) / made.side_px for one in right]
        for one in detections:
            if one not in right:
                name, u, v = min(made.likenesses, key=lambda like: math.dist(like[1:], one.centre_px))
                self.false.append(name if math.dist((u, v), one.centre_px) < made.side_px else "ground")

    @property
    def precision(self) -> float:
        return self.found / max(self.found + len(self.false), 1)


@pytest.fixture(scope="module")
def frames() -> list[SyntheticFrame]:
    """Three frames per height, each with five lookalikes."""
    return [frame(np.random.default_rng([int(height), k]), height) for height in HEIGHTS for k in range(3)]


def tallied(frames: list[SyntheticFrame], stages: int = 3, height_error: float = 1.0) -> dict[float, Tally]:
    """Tallies by height, with 0 for all heights."""
    detector = Detector([GLYPH], stages=stages)
    tallies = {height: Tally() for height in (0.0, *HEIGHTS)}
    for made in frames:
        detections = detector.detect(made.image, made.seen.height_m * height_error, FOCAL_PX)
        tallies[made.seen.height_m].add(made, detections)
        tallies[0.0].add(made, detections)
    return tallies


def test_targets_are_found_from_10_to_40_m_and_nothing_else(frames: list[SyntheticFrame]) -> None:
    """Precision at least 0.95; recall at least 0.90, 1 deg and 0.05 sides at the median, at every height."""
    tallies = tallied(frames)
    assert tallies[0.0].precision >= 0.95
    for tally in tallies.values():
        assert tally.found / (tally.found + tally.missed) >= 0.90
        assert math.degrees(np.median(tally.angles)) <= 1.0
        assert np.median(tally.places) <= 0.05


def test_each_stage_is_needed_and_loses_nothing(frames: list[SyntheticFrame]) -> None:
    """Colours alone accept all lookalikes in these colours; with rotation, only mirror images remain."""
    colours, turned = tallied(frames, stages=1)[0.0], tallied(frames, stages=2)[0.0]
    assert colours.missed == turned.missed == 0
    assert colours.precision < 0.25
    assert {"mirrored", "scrambled", "other"} <= set(colours.false)
    assert turned.precision == pytest.approx(0.5, abs=0.1)
    assert turned.false.count("mirrored") >= 0.9 * len(turned.false)


@pytest.mark.parametrize("error", [0.9, 1.1])
def test_heights_may_be_wrong_by_a_tenth(frames: list[SyntheticFrame], error: float) -> None:
    tally = tallied(frames, height_error=error)[0.0]
    assert tally.found / len(frames) >= 0.90
    assert tally.precision >= 0.95
    assert np.median(tally.places) <= 0.05


@pytest.mark.parametrize(("stages", "within"), [(2, 0.07), (3, 0.04)])
def test_the_detected_side_is_the_true_one(frames: list[SyntheticFrame], stages: int, within: float) -> None:
    """At any assumed height; the second stage tries sizes 6 % apart."""
    detector = Detector([GLYPH], stages=stages)
    for made in frames[::3]:
        for error in (0.9, 1.0, 1.1):
            detections = detector.detect(made.image, made.seen.height_m * error, FOCAL_PX)
            assert detections
            for one in detections:
                assert one.side_px == pytest.approx(made.side_px, rel=within)


@pytest.mark.parametrize("tilt", [0.1, 0.2])
def test_the_camera_may_be_tilted(frames: list[SyntheticFrame], tilt: float) -> None:
    """Of targets that are completely in the picture."""
    rng = np.random.default_rng(5)
    tally = Tally()
    detector = Detector([GLYPH])
    for made in frames:
        tilted_frame = tilted(made, tilt, rng.uniform(-math.pi, math.pi))
        (truth,) = tilted_frame.seen.truths
        edge = 0.8 * tilted_frame.side_px
        if edge < truth.u < ground.WIDTH - edge and edge < truth.v < ground.HEIGHT - edge:
            tally.add(tilted_frame, detector.detect(tilted_frame.image, tilted_frame.seen.height_m, FOCAL_PX))
    assert tally.found + tally.missed >= 10
    assert tally.found / (tally.found + tally.missed) >= 0.85
    assert tally.precision >= 0.90
    assert np.median(tally.places) <= 0.05


@pytest.mark.parametrize("quarter", range(4))
def test_angles_count_to_the_left(quarter: int) -> None:
    made = plain(lambda picture: np.rot90(picture, quarter))
    (one,) = Detector([GLYPH]).detect(made, 10.0, 400.0)
    assert abs(wrap(one.angle - quarter * math.pi / 2)) < math.radians(0.5)
    assert one.centre_px == pytest.approx((159.5, 119.5), abs=0.3)  # 80 px a side: between pixels
    assert one.side_px == pytest.approx(80.0, rel=0.02)


def plain(change: Callable[[Array], Array]) -> Array:
    """The target, changed by a function, 80 px a side in the middle of a grey picture."""
    picture = np.full((240, 320, 3), 110, np.uint8)
    picture[80:160, 120:200] = change(cv2.resize(glyph(), (80, 80), interpolation=cv2.INTER_AREA))
    return picture


def test_light_changes_neither_place_nor_angle() -> None:
    answers = []
    for light in (0.75, 1.0, 1.2):
        made = frame(np.random.default_rng(3), 25.0, light=light, noise=0.0)
        (one,) = Detector([GLYPH]).detect(made.image, 25.0, FOCAL_PX)
        answers.append((*one.centre_px, 10.0 * one.angle))
    assert np.ptp(answers, axis=0).max() < 0.2


def test_several_targets_of_several_sizes_in_one_pass() -> None:
    targets = [
        TargetPicture("one", glyph(), 2.0),
        TargetPicture("two", second_glyph(), 2.0),
        TargetPicture("large", second_glyph()[:, ::-1].copy(), 3.0),
    ]
    for k in range(4):
        made = frame(np.random.default_rng(k), 20.0, [("one", glyph()), ("two", second_glyph())], distractors=False)
        detections = Detector(targets).detect(made.image, 20.0, FOCAL_PX)
        assert {one.target for one in detections} == {"one", "two"}
        for truth in made.seen.truths:
            (one,) = [one for one in detections if one.target == truth.name]
            assert math.dist(one.centre_px, (truth.u, truth.v)) < 0.05 * made.side_px
    large = frame(np.random.default_rng(9), 20.0, [("large", targets[2].picture)], size_m=3.0, distractors=False)
    assert [one.target for one in Detector(targets).detect(large.image, 20.0, FOCAL_PX)] == ["large"]


def test_one_place_holds_one_target() -> None:
    """Of several similar targets, the most similar one."""
    duller = TargetPicture("duller", cv2.GaussianBlur(glyph(), (0, 0), 12.0), 2.0)
    for targets in ([GLYPH, duller], [duller, GLYPH]):
        (one,) = Detector(targets).detect(frame(np.random.default_rng(6), 15.0).image, 15.0, FOCAL_PX)
        assert one.target == "glyph"
    (alone,) = Detector([duller]).detect(frame(np.random.default_rng(6), 15.0).image, 15.0, FOCAL_PX)
    assert alone.target == "duller"


def test_a_region_gives_the_detections_of_the_whole_picture(frames: list[SyntheticFrame]) -> None:
    detector = Detector([GLYPH])
    for made in frames[::3]:
        (whole,) = detector.detect(made.image, made.seen.height_m, FOCAL_PX)
        u, v = whole.centre_px
        for reach in (2.0 * made.side_px, 0.6 * made.side_px, 0.05 * made.side_px):
            (one,) = detector.detect(made.image, made.seen.height_m, FOCAL_PX, (u - reach, v - reach, u + reach, v + reach))
            assert math.dist(one.centre_px, (u, v)) < 0.02 * made.side_px
            assert abs(wrap(one.angle - whole.angle)) < math.radians(1.0)
            beside = (u + reach, 0.0, 640.0, 480.0) if u < 320 else (0.0, 0.0, u - reach, 480.0)
            assert detector.detect(made.image, made.seen.height_m, FOCAL_PX, beside) == []


@pytest.mark.parametrize(
    ("height", "region"),
    [
        *((20.0, region) for region in ((700.0, 0.0, 800.0, 100.0), (50.0, 50.0, 40.0, 60.0), (-90.0, -90.0, -10.0, -10.0))),
        *((height, None) for height in (80.0, 1e9, 0.5, 0.0, -3.0, math.nan, math.inf)),
    ],
)
def test_outside_the_picture_and_at_unusable_heights_there_are_no_detections(height: float, region: Region | None) -> None:
    assert Detector([GLYPH]).detect(frame(np.random.default_rng(0), 20.0).image, height, FOCAL_PX, region) == []


def test_targets_partly_outside_are_never_misplaced() -> None:
    """With a tenth of the side beyond the border they are still found; all detections are at the true place."""
    detector = Detector([GLYPH])
    for beyond, at_least in ((0.1, 1), (0.25, 0), (0.5, 0), (0.6, 0)):
        for place in ((40.0 * (0.5 - beyond) - 0.5, 200.0), (300.0, 479.5 - 40.0 * (0.5 - beyond))):
            made = frame(np.random.default_rng(1), 20.0, places=[place], angles=[0.0], distractors=False)
            detections = detector.detect(made.image, 20.0, FOCAL_PX)
            assert at_least <= len(detections) <= 1
            for one in detections:
                assert math.dist(one.centre_px, place) < 0.1 * 40.0


def test_detections_do_not_depend_on_history_or_threads(frames: list[SyntheticFrame]) -> None:
    first = [Detector([GLYPH]).detect(made.image, made.seen.height_m, FOCAL_PX) for made in frames[::3]]
    detector, threads = Detector([GLYPH]), cv2.getNumThreads()
    try:
        for number in (1, 4):
            cv2.setNumThreads(number)
            again = [detector.detect(made.image, made.seen.height_m, FOCAL_PX) for made in reversed(frames[::3])]
            assert again[::-1] == first
    finally:
        cv2.setNumThreads(threads)


def test_pictures_are_read_from_files(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "glyph.png"), glyph()[:, :, ::-1])
    assert np.array_equal(TargetPicture.load("glyph", tmp_path / "glyph.png", 2.0).picture, glyph())
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "empty.png").write_text("")
    for name in ("text.png", "empty.png", "none.png"):
        with pytest.raises(ScenarioError, match="picture"):
            TargetPicture.load("glyph", tmp_path / name, 2.0)


@pytest.mark.parametrize(
    ("picture", "size_m", "words"),
    [
        (np.full((64, 64, 3), 128, np.uint8), 2.0, "grey"),
        (glyph()[:100], 2.0, "square, 16 pixels or more a side, not 128 x 100"),
        (glyph()[:8, :8], 2.0, "16 pixels"),
        (glyph()[:, :, 0], 2.0, "RGB"),
        (glyph().astype(float), 2.0, "uint8"),
        (glyph(), 0.0, "greater than 0 m"),
        (glyph(), math.nan, "greater than 0 m"),
    ],
)
def test_invalid_targets_are_refused(picture: Array, size_m: float, words: str) -> None:
    with pytest.raises(ScenarioError, match=words):
        TargetPicture("glyph", picture, size_m)
