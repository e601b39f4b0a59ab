"""Figures of recognition: counts, scores of the stages, and all figures whole with few pictures."""

import math
from pathlib import Path

import numpy as np
import pytest

from tests.support.cosim.figures import draw_figure, missed
from vcmvsp.agents.reconnaissance.recognition.detector import Detection
from vcmvsp.agents.reconnaissance.recognition.ground import Truth
from vcmvsp.agents.reconnaissance.recognition.inspection import colour_map
from vcmvsp.cosim.reproduction.figures.search import recognition_stages
from vcmvsp.cosim.reproduction.figures.search.synthetic_pictures import (
    KINDS,
    Tally,
    box,
    synthetic_frame,
    target,
    together,
)

pytestmark = pytest.mark.slow

FOCAL_PX = 400.0


def detection(u: float, v: float, angle: float = 0.0, name: str = "glyph") -> Detection:
    return Detection(name, (u, v), angle, 40.0, 1.0, 1.0, 1.0)


def test_each_target_is_found_once_and_all_else_is_false() -> None:
    """Side 40 px: a detection within 10 px is right."""
    tally = Tally()
    tally.add([detection(109.0, 100.0, 0.1), detection(101.0, 100.0), detection(300.0, 90.0)], [Truth("glyph", 100, 100)], 40.0)
    tally.add([detection(100.0, 111.0)], [Truth("glyph", 100, 100)], 40.0)
    tally.add([detection(100.0, 100.0, name="other")], [Truth("glyph", 100, 100)], 40.0)
    assert (tally.recall, tally.precision) == ((1, 3), (1, 5))
    assert tally.angles == pytest.approx([0.1])
    assert tally.places == pytest.approx([9 / 40])
    both = together([tally, tally])
    assert (both.recall, both.precision, len(both.angles)) == ((2, 6), (2, 10), 2)


def test_boxes_turn_counter_clockwise_in_the_picture() -> None:
    """The first corner is the upper right one at 0 and the upper left one after a quarter turn; v points down."""
    for angle, (u, v) in ((0.0, (110.0, 40.0)), (0.5 * math.pi, (90.0, 40.0))):
        curve = box(100.0, 50.0, 20.0, angle, "", 0)
        assert (curve.x[0], curve.y[0]) == pytest.approx((u, v))
        assert (curve.x[-1], curve.y[-1]) == pytest.approx((u, v))


def test_colour_maps_have_their_peaks_in_the_picture() -> None:
    frame = synthetic_frame(15.0, 1)
    (truth,) = frame.seen.truths
    found = colour_map(target(), frame.image, 15.0, FOCAL_PX)
    near = np.hypot(found.peaks[:, 0] - truth.u, found.peaks[:, 1] - truth.v)
    assert near.min() < 0.15 * frame.side_px
    row, column = round((truth.v + 0.5) * found.scale - 0.5), round((truth.u + 0.5) * found.scale - 0.5)
    assert found.score[row, column] > 0.9 * 255 * found.peaks[near.argmin(), 2]


def test_recognition(tmp_path: Path) -> None:
    figure = draw_figure("recognition", tmp_path, 6, frames=3)
    assert missed(figure) == []
    assert len(figure.rows) == 2 * 5 * 4 + 3 + 1


@pytest.mark.parametrize(("name", "panels"), [("46", 5), ("47", 6)])
def test_stages(name: str, panels: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Scores above and below the thresholds of the stages, and angles within a degree."""
    monkeypatch.setattr(recognition_stages, "TURNS_DEG", (0, 15, 20, 90))
    monkeypatch.setattr(recognition_stages, "SHIFTS_PX", (0, 4, 7))
    figure = draw_figure(name, tmp_path, panels, frames=1)
    assert missed(figure) == []
    if name == "47":
        assert all(any(kind in row.case for row in figure.rows) for kind in KINDS)
