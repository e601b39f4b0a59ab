"""Style of figures: colours distinguishable for all kinds of vision, series that differ in colour and marker, units at every
axis, legends that cover nothing, reproducible drawings.
"""

import ast
import io
import itertools
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D

from tests.cosim.studies.test_outputs import DELAY, LOSS, METRIC, study
from tests.support.cosim import recordings
from tests.support.cosim.reconnaissance_recording import TARGETS, reconnaissance_recorder
from tests.support.paths import ROOT
from vcmvsp.cosim.analysis import coverage as coverages
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.plots import mission_plot, radio_plots, run_plots, study_plot
from vcmvsp.cosim.plots.radio_plots import draw_calibration
from vcmvsp.cosim.plots.study_plot import label_of
from vcmvsp.cosim.plots.style import line_of, save_png, style, svg
from vcmvsp.cosim.recording.mission_log import read_mission
from vcmvsp.cosim.reproduction.figures import drawing as figure_plot
from vcmvsp.cosim.reproduction.figures.figure import Curve, Figure, Heat, Panel, Photo
from vcmvsp.cosim.studies.rows import flat
from vcmvsp.cosim.studies.summary import summarise
from vcmvsp.cosim.util.palette import COMMANDERS, OKABE_ITO, rgb

pytestmark = pytest.mark.slow

Array = np.ndarray
FIGURES = ROOT / "cosim" / "reproduction" / "figures"

# Labels of pure numbers, by the reason for the missing unit.
PURE = {
    "a share, from 0 to 1": {
        "share of the start", "share of the targets", "share of the target", "share of frames delivered", "probability of loss",
        "loss probability",
    },
    "a number of things": {"beams", "number of peaks", "periods since the step", "from the most frequent one", "link"},
    "one length over another, or what has the same unit": {
        "sway over that of the predecessor", "age of reports / tau*", "growth per tau*", "growth per s", "kappa lambda_max T",
        "error",
    },
    "a score of recognition": {"score", "score of stage 2", "score of stage 3"},
    "rows of marks, with their names": {"lost", ""},
    "of this test": {"p"},
}  # fmt: skip
ALLOWED = set().union(*PURE.values())
COUNTS = re.compile(
    r"(overshoot|hop_gain|shape_changes|mode_toggles|frames|receptions|under_way|losses\..*|delivery_ratio|connectivity\..*|late|missed"
    r"|reconnects|collisions|seed|targets_\w+|false_finds|area_seen_ratio|switches|map_bytes_sent|schema|scenario|digest)$"
)

# Machado, Oliveira, Fernandes: "A physiologically-based model for simulation of color vision deficiency" (2009), severity 1.
SEEN_BY = {
    "everybody else": np.eye(3),
    "protanopia": np.array([(0.152286, 1.052583, -0.204868), (0.114503, 0.786281, 0.099216), (-0.003882, -0.048116, 1.051998)]),
    "deuteranopia": np.array(
        [(0.367322, 0.860646, -0.227968), (0.280085, 0.672501, 0.047413), (-0.011820, 0.042940, 0.968881)]
    ),
    "tritanopia": np.array([(1.255528, -0.076749, -0.178779), (-0.078411, 0.930809, 0.147602), (0.004733, 0.691367, 0.303900)]),
}


def linear(code: str) -> Array:
    """A colour as linear RGB, 0 to 1."""
    value = np.array(rgb(code))
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def lab(light: Array) -> Array:
    """CIE L*a*b* under D65, of linear sRGB."""
    to_xyz = np.array([(0.4124564, 0.3575761, 0.1804375), (0.2126729, 0.7151522, 0.0721750), (0.0193339, 0.1191920, 0.9503041)])
    x, y, z = (to_xyz @ light) / (0.95047, 1.0, 1.08883)
    fx, fy, fz = (np.cbrt(t) if t > 216 / 24389 else (24389 / 27 * t + 16) / 116 for t in (x, y, z))
    return np.array([116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)])


def colour_difference(one: str, other: str, vision: Array) -> float:
    """Colour difference (CIE 1976) under a kind of vision (matrix ``vision``); 2.3 is just noticeable."""
    first, second = (lab(np.clip(vision @ linear(code), 0.0, 1.0)) for code in (one, other))
    return float(np.linalg.norm(first - second))


# --- colours and lines -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("vision", SEEN_BY)
@pytest.mark.parametrize("palette", [OKABE_ITO, tuple(COMMANDERS.values())], ids=["series", "commanders"])
def test_colours_differ_for_all_vision(palette: tuple[str, ...], vision: str) -> None:
    assert min(colour_difference(*pair, SEEN_BY[vision]) for pair in itertools.combinations(palette, 2)) > 15.0


def test_series_differ_without_their_colours() -> None:
    """Neighbours have different markers; no two of 56 are equal in colour and marker."""
    looks = [line_of(index) for index in range(56)]
    assert all(one["marker"] != next_["marker"] for one, next_ in itertools.pairwise(looks))
    assert len({(look["color"], look["marker"]) for look in looks}) == 56
    assert looks[0]["linestyle"] != looks[len(OKABE_ITO)]["linestyle"]


def test_commanders_differ_without_their_colours() -> None:
    assert len(set(mission_plot.HATCHES.values())) == len(COMMANDERS) == len(mission_plot.HATCHES)


# --- every figure ------------------------------------------------------------------------------------------------------------


def run() -> dict[str, Canvas]:
    poses = {f"car{i}": (float(i), 0.1 * i, 0.2) for i in range(3)}
    events = [
        recordings.states(k * SECOND_NS // 10, {n: (x + 0.1 * k, y, a) for n, (x, y, a) in poses.items()}) for k in range(30)
    ]
    events += [recordings.follows(f"car{i}", "car0", (-1.0, 0.5 * i), 0.1) for i in (1, 2)]
    for k in range(20):
        at = k * SECOND_NS // 10
        events.append(recordings.frame(k, "car0", at, {"car1": at + 1000 if k % 3 else None, "car2": at + 1000}))
    recorder = recordings.recorder_after(list(poses), events, 3 * SECOND_NS)
    error = run_plots.formation_error(recorder.states, recorder.radio, recorder.follows, (1.0, None))
    alone = run_plots.formation_error(recorder.states, recorder.radio.slice(0, 0), recorder.follows)
    return {
        "trajectory": run_plots.trajectory(recorder.states, recorder.follows),
        "formation_error": error,
        "without radio": alone,
    }


def mission() -> dict[str, Canvas]:
    recorder, stream = reconnaissance_recorder(("uav1", "uav2"))
    log = read_mission(io.BytesIO(stream.getvalue()), ("uav1", "uav2"), 20 * SECOND_NS)
    moved = motion(recorder.states)
    return {
        "mission": mission_plot.mission(log, moved, TARGETS, ()),
        "mosaic": mission_plot.mosaic(log, moved, TARGETS),
        "detections": mission_plot.detections(log),
    }


def study_figures() -> dict[str, Canvas]:
    vary = {DELAY: [2.0, 0.5], LOSS: [0.1, 0.9, 0.5]}
    summary = summarise(study(vary)[0], list(vary), [METRIC, "radio.delivery_ratio"])
    over_two = study_plot.heat_map(summary, list(vary), METRIC, "over two")
    assert over_two is not None
    return {"lines": study_plot.lines(summary, list(vary), [METRIC, "radio.delivery_ratio"], "lines"), "map": over_two}


def calibration() -> dict[str, Canvas]:
    at = np.linspace(1.0, 50.0, 60)
    level = np.where(at > 45.0, np.nan, -40.0 - 20.0 * np.log10(at))
    figure = draw_calibration(
        distance_m=at, level_dbm=level, line_m=at, line_dbm=-40.0 - 20.0 * np.log10(at), sigma_db=3.0, sensitivity_dbm=-73.0,
        walls=True, moved_m=at, correlation=np.exp(-at), curve_m=at, curve=np.exp(-at), correlation_distance_m=1.0,
    )  # fmt: skip
    return {"calibration": figure}


def thesis() -> dict[str, Canvas]:
    x = np.linspace(0.1, 2.0, 30)
    curves = [Curve(x, x**k, f"power {k}", k) for k in range(1, 6)]
    marks = [Curve(x, x, "both", 1, "both"), Curve(x, 2 * x, "hollow", 2, "hollow"), Curve(x, 3 * x, "dotted", 3, "dotted")]
    probability = Heat(x, x, np.outer(x, x) / 4.0, "P(target) [1]", "map")
    panels = [
        Panel("lines", "x [m]", "y [m]", curves, levels={"limit": 1.0}),
        Panel("marks", "x [m]", "y [m]", marks, equal=True),
        Panel("a map", "x [m]", "y [m]", curves[:2], heat=probability),
        Panel("a photo", "u [px]", "v [px]", marks[:1], photo=Photo(np.zeros((3, 4, 3), np.uint8))),
        Panel("numbers", "p", "d [s]", heat=Heat(x[:3], x[:2], np.ones((2, 3)), "ratio", "about one")),
    ]
    return {"figure": figure_plot.draw(Figure("A figure", panels, []))}


def coverage() -> dict[str, Canvas]:
    return {"coverage": radio_plots.coverage(coverages.coverage("formation-circle", "car1", resolution_m=20.0))}


@cache
def every() -> dict[str, Canvas]:
    """One figure of each kind in the project."""
    kinds: tuple[Callable[[], dict[str, Canvas]], ...] = (run, mission, study_figures, calibration, thesis, coverage)
    return {name: figure for kind in kinds for name, figure in kind().items()}


NAMES = (
    "trajectory", "formation_error", "without radio", "mission", "mosaic", "detections", "lines", "map", "calibration",
    "figure", "coverage",
)  # fmt: skip


def test_every_kind_is_listed() -> None:
    assert tuple(every()) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_every_axis_has_a_unit_and_every_figure_a_title_in_one_size(name: str) -> None:
    figure = every()[name]
    title = figure._suptitle  # type: ignore[attr-defined]
    assert (bool(title.get_text()), title.get_size()) == (True, 11)
    shown = [axes for axes in figure.axes if axes.get_visible() and axes.axison]
    labels = {axes.get_xlabel() for axes in shown} | {axes.get_ylabel() for axes in shown}
    labels |= {text.get_text() for text in (figure._supxlabel, figure._supylabel) if text is not None}  # type: ignore[attr-defined]
    assert {label for label in labels if not re.search(r"\[.+\]$", label)} <= ALLOWED


@pytest.mark.parametrize("name", NAMES)
def test_legends_hide_nothing(name: str) -> None:
    """They lie outside axes and titles and within the figure."""
    figure = every()[name]
    svg(figure)  # computes the layout
    axes = [each for each in figure.axes if each.get_visible()]
    legends = [legend for legend in (*(each.get_legend() for each in axes), *figure.legends) if legend is not None]
    assert legends or name in ("detections", "coverage", "map")
    for legend in legends:
        box = legend.get_window_extent()
        assert figure.bbox.padded(1.0).containsx(box.x0)
        assert figure.bbox.padded(1.0).containsx(box.x1)
        for each in (*axes, figure._suptitle):  # type: ignore[attr-defined]
            inside = each.get_window_extent()
            assert (
                min(box.x1, inside.x1) - max(box.x0, inside.x0) < 1.0 or min(box.y1, inside.y1) - max(box.y0, inside.y0) < 1.0
            )


def test_every_panel_of_the_thesis_figures_has_units() -> None:
    """From the source text: making the figures takes minutes."""
    found: list[str] = []
    for path in sorted(FIGURES.rglob("*.py")):
        for call in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "Panel":
                found += [
                    each.value for each in call.args[1:3] if isinstance(each, ast.Constant) and isinstance(each.value, str)
                ]
    assert len(found) > 70
    assert {label for label in found if not re.search(r"\[.+\]$", label)} <= ALLOWED


def test_every_number_of_a_run_is_named_with_its_unit() -> None:
    recorder, _ = reconnaissance_recorder(("uav1", "uav2"))
    names = flat(recorder.metrics(window=(0.0, None)))
    assert len(names) > 40
    assert [name for name in names if "[" not in label_of(name) and not COUNTS.search(name)] == []


# --- drawings ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_drawing_is_reproducible_and_keeps_the_figure(name: str, tmp_path: Path) -> None:
    figure = every()[name]
    save_png(figure, tmp_path / "before.png")
    drawing = svg(figure)
    save_png(figure, tmp_path / "after.png")
    assert svg(figure) == drawing
    assert (tmp_path / "before.png").read_bytes() == (tmp_path / "after.png").read_bytes()
    assert len(drawing) < 1_500_000
    assert "<metadata" not in drawing
    assert "matplotlib.org" not in drawing


def test_a_figure_is_drawn_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    drawn: list[Canvas] = []
    draw = Canvas.draw

    def counted(figure: Canvas, renderer: RendererBase) -> None:
        drawn.append(figure)
        draw(figure, renderer)

    monkeypatch.setattr(Canvas, "draw", counted)
    save_png(thesis()["figure"], tmp_path / "figure.png")
    assert len(drawn) == 1


def one_line(x: Array, y: Array, look: str) -> str:
    with style():
        figure = Canvas(figsize=(5.0, 5.0))
        axes = figure.add_subplot()
        axes.plot(x, y, look, gid="it")
        axes.set_aspect("equal")
        axes.set_title("1.23456 <b>")
    return svg(figure)


def test_curves_are_simplified_invisibly() -> None:
    """A circle of 20,000 points becomes one of few, nowhere 0.1 pt off, between its points too; its numbers are short."""
    turn = np.linspace(0.0, 2.0 * np.pi, 20_000)
    drawing = one_line(np.cos(turn), np.sin(turn), "-")
    found = re.search(r'<g id="it">\s*<path d="([^"]*)"', drawing)
    assert found is not None
    points = np.array([[float(each) for each in pair] for pair in re.findall(r"([\d.]+) ([\d.]+)", found[1])])
    assert 30 < len(points) < 2000
    middles = 0.5 * (points[1:] + points[:-1])
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    away = np.hypot(*(np.concatenate([points, middles]) - centre).T)
    assert np.ptp(away) < 0.1
    assert not re.search(r"\.\d{3}", found[1])
    assert ">1.23456 &lt;b&gt;<" in drawing  # text is unchanged


def test_only_dense_marks_are_rasterised() -> None:
    x = np.linspace(0.0, 1.0, 5000)
    assert "<image" in one_line(x, x, ".")
    assert "<image" not in one_line(x[:100], x[:100], ".")
    assert "<image" not in one_line(x, x, "-")


def test_each_line_is_rasterised_separately() -> None:
    """Rasterising is set per line."""
    with style():
        figure = Canvas()
        axes = figure.add_subplot()
        axes.plot(np.arange(3000), np.arange(3000), ".")
        axes.plot([0, 1], [0, 1], "o")
    svg(figure)
    assert [line.get_rasterized() for line in axes.lines if isinstance(line, Line2D)] == [True, False]
