"""Stages of recognition: differences that each of them detects, and others that it cannot detect."""

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vcmvsp.agents.reconnaissance.recognition import stages as colours
from vcmvsp.agents.reconnaissance.recognition.detector import RINGS, _Search
from vcmvsp.agents.reconnaissance.recognition.ground import BLUE, RED, glyph, mirrored
from vcmvsp.agents.reconnaissance.recognition.stages import (
    FULL,
    TURNS,
    MatchedPose,
    Rings,
    TargetPicture,
    match,
    rotation,
    vertex,
)
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array

MIDDLE = (np.array([23.5]), np.array([23.5]), np.array([48.0]))  # middle and side of a patch
TEMPLATE = TargetPicture("glyph", glyph(), 2.0).template(48)


def turned(picture: Array, angle: float, side: int = 48) -> Array:
    """A picture turned counter-clockwise, in the middle of a grey picture of 144 x 144."""
    M = cv2.getRotationMatrix2D((0.5 * (picture.shape[1] - 1),) * 2, math.degrees(angle), side / picture.shape[1])
    M[:, 2] += 71.5 - 0.5 * (picture.shape[1] - 1)
    smooth = cv2.GaussianBlur(picture, (0, 0), 0.35 * picture.shape[1] / side)
    return np.asarray(cv2.warpAffine(smooth, M, (144, 144), flags=cv2.INTER_AREA, borderValue=(110, 110, 110)))


def rings(picture: Array) -> tuple[float, Array]:
    """The cosine between the target and the middle of a picture, and the spectra."""
    at = np.array([71.5])
    spectra = FULL.spectra(picture, at, at, np.array([48.0]))
    return float(FULL.signatures(spectra).unit[0] @ TEMPLATE.full.unit[0]), spectra[:, 0]


def test_reduced_pictures_have_their_edges_in_the_same_places() -> None:
    """Also for sizes that are no multiple of the reduction; an odd row and column at the end are dropped."""
    search = _Search(np.zeros((53, 101, 3), np.uint8), left=7, top=9, inside=(0.0, 0.0, 0.0, 0.0)).reduced(0.3)
    assert search.image.shape[:2] == (16, 30)
    u, v = np.array([7 - 0.5, 7 + 100 - 0.5]), np.array([9 - 0.5, 9 + 52 - 0.5])
    across, down = search.within(u, v)
    assert np.allclose(across, [-0.5, 29.5])
    assert np.allclose(down, [-0.5, 15.5])
    assert np.allclose(search.outside(across, down), (u, v))


@pytest.mark.parametrize(("more", "less"), [(RED, BLUE), (BLUE, RED)])
def test_hues_are_the_most_frequent_first_with_their_shares(more: tuple[int, ...], less: tuple[int, ...]) -> None:
    picture = np.full((40, 40, 3), 128, np.uint8)  # pale: no hue
    picture[:10] = less
    picture[10:30] = more
    found = colours.hues(picture)
    assert found.shares == (0.5, 0.25)
    first, second = cv2.cvtColor(np.array([[more, less]], np.uint8), cv2.COLOR_RGB2HSV)[0, :, 0].tolist()
    assert (found.label[first], found.label[second], found.label[60], found.label[255]) == (1, 2, 0, 0)


def test_at_most_four_hues_and_no_rare_ones() -> None:
    """Six hues 30 apart, with shares from 2 % to 30 %."""
    hsv = np.full((100, 10, 3), 200, np.uint8)
    rows = (30, 25, 20, 15, 8, 2)
    hsv[:, :, 0] = np.repeat(30 * np.arange(6), rows)[:, None]
    assert colours.hues(np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))).shares == (0.3, 0.25, 0.2, 0.15)
    hsv[:90, :, 0] = 0
    hsv[90:98, :, 0] = 120
    assert colours.hues(np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))).shares == (0.9, 0.08)


def test_hues_go_round_in_a_circle() -> None:
    """Reds lie on both sides of 0."""
    hsv = np.full((20, 20, 3), 200, np.uint8)
    hsv[:10, :, 0], hsv[10:, :, 0] = 178, 1
    assert colours.hues(np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))).shares == (1.0,)


def test_the_score_of_a_hue_is_at_most_its_share_of_the_target() -> None:
    """Target: four sevenths red, two blue. All red scores 2/3, all blue 1/3, these shares 1 in any arrangement."""
    row = np.array([RED] * 4 + [BLUE] * 2 + [(128, 128, 128)], np.uint8)
    hues = colours.hues(np.tile(row, (7, 3, 1)))
    for picture, expected in (
        (np.full((63, 63, 3), RED, np.uint8), 2 / 3),
        (np.full((63, 63, 3), BLUE, np.uint8), 1 / 3),
        (np.full((63, 63, 3), 128, np.uint8), 0.0),
        (np.tile(row[::-1][:, None], (9, 63, 1)), 1.0),
    ):
        scores = colours.colour_scores(cv2.cvtColor(picture, cv2.COLOR_RGB2HSV), hues, 21)
        assert scores[31, 31] / 255 == pytest.approx(expected, abs=0.01)


@pytest.mark.parametrize("angle", np.linspace(-3.1, 3.1, 12).tolist())
def test_turning_changes_neither_magnitudes_nor_detections(angle: float) -> None:
    picture = turned(glyph(), angle)
    cosine, spectrum = rings(picture)
    assert cosine > 0.97
    estimate = rotation(spectrum, TEMPLATE.full.spectra[:, 0])
    assert abs(wrap(estimate - angle)) < math.radians(2.0)
    score, pose = match(picture, TEMPLATE, MatchedPose(71.5, 71.5, estimate, 48.0))
    assert score > 0.95
    assert abs(wrap(pose.angle - angle)) < math.radians(0.5)
    assert math.dist((pose.u, pose.v), (71.5, 71.5)) < 0.3


def test_a_negative_differs_in_its_means_only() -> None:
    """Only harmonic 0 has a sign: the cosine falls by twice its share."""
    negative = FULL.spectra(255 - TEMPLATE.patch, *MIDDLE)
    means = TEMPLATE.full.unit[0, : TEMPLATE.full.spectra.shape[2]]
    cosine = float(FULL.signatures(negative).unit[0] @ TEMPLATE.full.unit[0])
    assert cosine == pytest.approx(1.0 - 2.0 * float(means @ means), abs=0.01)
    assert cosine < RINGS


@given(steps=st.integers(0, TURNS - 1))
@settings(max_examples=20)
def test_phases_give_a_turn_exactly(steps: int) -> None:
    """A ring turned by phi is the ring times phases, without a picture."""
    spectrum = TEMPLATE.full.spectra[:, 0]
    angle = math.tau * steps / TURNS
    phases = np.exp(-1j * np.arange(len(spectrum)) * angle)[:, None]
    assert abs(wrap(rotation(spectrum * phases, spectrum) - angle)) < 1e-5


def test_correlation_detects_mirror_images_and_magnitudes_do_not() -> None:
    picture = turned(mirrored(glyph()), 0.7)
    cosine, spectrum = rings(picture)
    assert cosine > 0.97
    best = max(
        match(picture, TEMPLATE, MatchedPose(71.5, 71.5, angle, 48.0))[0] for angle in np.linspace(-math.pi, math.pi, 73)
    )
    assert best < 0.65
    assert match(picture, TEMPLATE, MatchedPose(71.5, 71.5, rotation(spectrum, TEMPLATE.full.spectra[:, 0]), 48.0))[0] < 0.65


def test_templates_are_blurred_as_the_camera_blurs() -> None:
    """A target of 16 px a side matches the template for 16 px better than a sharp one; one of 64 px vice versa."""
    for side, other in ((16, 200), (64, 16)):
        picture, start = turned(glyph(), 0.0, side), MatchedPose(71.5, 71.5, 0.0, float(side))
        target = TargetPicture("glyph", glyph(), 2.0)
        assert match(picture, target.template(side), start)[0] > match(picture, target.template(other), start)[0] + 0.005


@given(shift=st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0)), scale=st.floats(0.95, 1.05))
@settings(max_examples=20)
def test_matching_corrects_place_and_size(shift: tuple[float, float], scale: float) -> None:
    picture = turned(glyph(), 0.3)
    score, pose = match(picture, TEMPLATE, MatchedPose(71.5 + shift[0], 71.5 + shift[1], 0.33, 48.0 * scale))
    assert score > 0.95
    assert math.dist((pose.u, pose.v), (71.5, 71.5)) < 0.5
    assert pose.side_px == pytest.approx(48.0, rel=0.025)  # at worst 2.35 %, over a grid of 845 places and sizes


def test_patches_at_once_equal_patches_one_by_one() -> None:
    rng = np.random.default_rng(2)
    picture = rng.integers(0, 255, (100, 120, 3), np.uint8)
    u, v, side = rng.uniform(20, 80, 7), rng.uniform(20, 80, 7), rng.uniform(20, 40, 7)
    some = Rings(36, 12)
    together = some.signatures(some.spectra(picture, u, v, side)).unit
    for i in range(7):
        part = slice(i, i + 1)
        alone = some.signatures(some.spectra(picture, u[part], v[part], side[part])).unit
        assert np.allclose(together[i], alone[0], atol=1e-6)


@given(at=st.floats(-0.5, 0.5), bend=st.floats(0.1, 10.0), height=st.floats(-5.0, 5.0))
def test_the_vertex_of_a_parabola_is_exact(at: float, bend: float, height: float) -> None:
    values = height - bend * (np.arange(-2, 3) - at) ** 2
    assert vertex(values, 2) == pytest.approx(at, abs=1e-9)
    assert vertex(values, 0) == vertex(values, 4) == 0.0
