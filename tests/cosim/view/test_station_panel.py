"""Texts and curves of the control station's panel, without a browser."""

import math
import re

import numpy as np
import pytest
import viser
from hypothesis import given
from hypothesis import strategies as st

from tests.support.cosim.view_pages import moving_state, open_station, scenery, station_state
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.types import Presence, RealStatus
from vcmvsp.cosim.view.messages import Craft, Pace, PageUpdate
from vcmvsp.cosim.view.page.charts import DELIVERY, POINTS, History, in_unit, limits_of, readable_unit, round_above
from vcmvsp.cosim.view.page.panel import log_page, run_page, team_page, vehicle_page
from vcmvsp.cosim.view.page.state import PageState
from vcmvsp.cosim.view.page.vehicles import places_of

pytestmark = pytest.mark.sockets


def test_foreign_texts_are_no_markup() -> None:
    bad = "<script>alert(1)</script>\x1b[31m"
    crafts = (Craft(name="v1", kind=bad, size=(1, 1, 1), agent=bad),)
    scene = scenery(vehicles=crafts, scenario=bad)
    known = station_state(
        scene,
        PageUpdate(
            time_ns=0,
            notes={"v1": {"mode": bad, bad: bad}},
            presence={"v1": Presence(state="lost", since_ns=0, why=bad)},
            real={"v1": RealStatus(link=1, age_s=0.1, causes=(bad,))},
            lines=(LogLine(time_ns=0, level=bad, text=bad),),
            pace=Pace(over=bad),
        ),
    )
    for page in (vehicle_page(known, 0), run_page(known), log_page(known)):
        assert "<script" not in page
        assert "\x1b" not in page
        assert "alert(1)" in page


def test_the_chosen_vehicle_is_described_in_full() -> None:
    scene = scenery(3)
    known = station_state(
        scene,
        moving_state(
            scene,
            2.0,
            notes={"v2": {"mode": "avoid", "gap": 1.25}},
            real={"v2": RealStatus(link=1, age_s=0.1, battery_v=11.9, late_s=0.004)},
            presence={"v2": Presence(state="back", since_ns=SECOND_NS)},
            heard_ns={"v2": SECOND_NS},
            halted=("v2",),
        ),
    )
    page = vehicle_page(known, 1)
    for words in (
        "v2",
        "p2dx",
        "follow, every 0.1 s",
        "avoid",
        "1.25",
        "0.60 m/s",
        "11.9 V",
        "back since 1.00 s",
        "1.00 s ago",
    ):
        assert words in page
    for words in ("by the operator", "4 ms", "to 21/21 (100 %), from 21/21 (100 %)", "to 21/21 (100 %), from 10/21 (48 %)"):
        assert words in page


def test_time_and_speed_of_the_run_are_shown() -> None:
    scene = scenery(1)
    pace = Pace(speed=2.0, achieved=1.5)
    page = run_page(station_state(scene, moving_state(scene, 1.5, pace=pace)))
    assert "<b>1.50 s</b> of 60 s" in page
    assert "running at 2x, reaches 1.5x" in page
    assert "Run finished: Ctrl-C" in run_page(station_state(scene, moving_state(scene, 1.5, pace=Pace(over="Ctrl-C"))))


# --- curves ---


def test_delivery_covers_the_last_five_seconds() -> None:
    scene = scenery(2)
    history = History(scene)
    known = PageState(scene)
    for second in range(21):  # all received in the first ten seconds, nothing in the next ten
        sent, received = np.full((2, 2), 10 * second), np.full((2, 2), 10 * min(second, 10))
        known.take(PageUpdate(time_ns=second * SECOND_NS, sent=sent, received=received))
        history.sample(known)
    delivery = np.array(history.numbers[DELIVERY])[:, 0]
    assert delivery[[5, 10]].tolist() == [100.0, 100.0]
    assert delivery[[12, 20]].tolist() == [60.0, 0.0]


def test_curves_are_bounded_and_begin_anew_where_time_goes_back() -> None:
    scene = scenery(2)
    history, known = History(scene), PageState(scene)
    for second in range(2 * POINTS):
        known.take(moving_state(scene, float(second)))
        assert history.sample(known)
    assert len(history.time_s) == len(history.numbers[DELIVERY]) == POINTS
    assert not history.sample(known)  # nothing new
    known.take(moving_state(scene, 3.0))
    assert history.sample(known)
    assert list(history.time_s) == [3.0]


def test_charts_show_first_and_chosen_vehicles_and_known_values() -> None:
    with open_station(scenery(9)) as station_page:
        for second in range(3):
            station_page.show(float(second), places={}, sent=None, heard_ns={})
        (speed,) = station_page.parts(viser.GuiUplotHandle)
        assert speed.title == "Speed [m/s], 7 of 9 vehicles"
        assert [each["label"] for each in speed.series[1:]] == [f"v{index}" for index in range(1, 8)]
        assert speed.data[0].tolist() == [0.0, 1.0, 2.0]
        assert speed.data[1] == pytest.approx([0.3 * 2.25] * 3)
        texts = [text.content for text in station_page.parts(viser.GuiMarkdownHandle)]
        assert "*Formation error [m], 7 of 9 vehicles: no value*" in texts
        station_page.use("Vehicle", "v9")
        station_page.show(3.0, sent=None, heard_ns={})
        speed, error = station_page.parts(viser.GuiUplotHandle)
        assert [each["label"] for each in speed.series[1:]][-1] == "v9"
        assert error.title == "Formation error [m], 7 of 9 vehicles"


def test_any_note_and_quantity_has_a_chart_and_a_logarithmic_one_shows_small_numbers() -> None:
    with open_station(scenery(3)) as station_page:
        station_page.show(0.0)
        for second, gap_m in enumerate((0.002, 0.05), 1):
            station_page.show(float(second), notes={"v1": {"gap_m": gap_m}, "v2": {"gap_m": -1.0, "status": "waiting"}})
        station_page.use("Chart 4", "note gap_m")
        station_page.use("Chart 1", "East [m]")
        station_page.show(3.0, notes={})
        east, *_, note = station_page.parts(viser.GuiUplotHandle)
        assert (east.title, note.title) == ("East [m]", "note gap_m")
        assert east.data[1] == pytest.approx([2.0 * math.cos(0.3 * second) for second in range(4)])
        assert np.isnan(note.data[1][0])  # not yet noted
        assert note.data[1][1:] == pytest.approx([0.002, 0.05, 0.05])
        assert note.data[2][1:] == pytest.approx([-1.0, -1.0, -1.0])
        assert note.scales is not None
        assert note.scales["y"]["range"] == (-1.0, pytest.approx(0.05))
        station_page.use("Log scale")
        station_page.show(4.0, notes={})
        *_, note = station_page.parts(viser.GuiUplotHandle)
        assert note.scales is not None
        assert note.scales["y"] == {"range": (pytest.approx(1e-3), pytest.approx(0.1)), "distr": 3}
        assert np.isnan(note.data[2]).all()
        station_page.show(5.0, notes={"v1": {"gap_m": 0.0001}})
        *_, note = station_page.parts(viser.GuiUplotHandle)
        assert note.title == "note gap_m [0.001]"
        assert note.data[1][-1] == pytest.approx(0.1)
        assert note.scales is not None
        assert note.scales["y"]["range"] == pytest.approx((0.1, 100.0))
        station_page.use("Chart 1", "none")
        station_page.show(6.0, notes={})
        assert "East [m]" not in [chart.title for chart in station_page.parts(viser.GuiUplotHandle)]


def test_charts_of_the_chosen_vehicle_alone() -> None:
    with open_station(scenery(3)) as station_page:
        station_page.use("Curves of", "the chosen vehicle")
        station_page.use("Vehicle", "v2")
        station_page.show(1.0)
        station_page.show(2.0)
        speed, *_ = station_page.parts(viser.GuiUplotHandle)
        assert [each["label"] for each in speed.series[1:]] == ["v2"]
        assert speed.title == "Speed [m/s], 1 of 3 vehicles"


def test_the_level_is_of_the_newest_received_frame() -> None:
    scene = scenery(3)
    known = station_state(scene, moving_state(scene, 1.0))  # the last vehicle's frames are lost, and are the last
    assert known.level_dbm.tolist() == [-90.0, -90.0, -45.0]
    assert np.isnan(station_state(scene).level_dbm).all()


@pytest.mark.parametrize(
    ("values", "ends"),
    [
        ([0.1, 0.7], (0.0, 1.0)),
        ([0.3, 0.3], (0.0, 0.5)),
        ([0.0, 0.0], (0.0, 0.01)),
        ([-3.0, 4.0], (-5.0, 5.0)),
        ([-90.0, -20.0], (-100.0, 0.0)),
        ([120.0, 133.0], (120.0, 140.0)),
        ([-80.0, -71.0], (-80.0, -70.0)),
    ],
)
def test_axes_begin_at_zero_unless_all_values_are_far_from_it(values: list[float], ends: tuple[float, float]) -> None:
    assert limits_of(np.array(values), log=False) == pytest.approx(ends)


def test_the_team_table_sorts_by_largest_values() -> None:
    scene = scenery(4)
    heard_ns = {"v1": 0, "v2": 3 * SECOND_NS, "v3": 2 * SECOND_NS}
    notes = {"v4": {"status": "<b>waiting</b>"}}
    known = station_state(scene, moving_state(scene, 4.0, heard_ns=heard_ns, notes=notes, halted=("v2",)))

    def order(by: str) -> list[str]:
        return re.findall(r"<td>(v\d)</td>", team_page(known, by))

    assert order("name") == ["v1", "v2", "v3", "v4"]
    assert order("age") == ["v1", "v3", "v2", "v4"]  # v4 has received nothing
    errors = dict(zip(("v2", "v3"), places_of(known).error_m, strict=True))
    assert order("error")[:2] == sorted(errors, key=errors.__getitem__, reverse=True)
    assert "&lt;b&gt;waiting" in team_page(known, "status")
    assert order("status")[-1] == "v2"  # stopped


@given(st.floats(0.011, 1e6))
def test_axes_end_little_above_their_values(number: float) -> None:
    top = round_above(number)
    assert number * (1.0 - 1e-6) <= top <= 2.5 * number * (1.0 + 1e-6)
    assert round_above(top) == top


@given(st.floats(1e-12, 1e12))
def test_three_decimals_of_a_unit_show_the_end_of_an_axis(low: float) -> None:
    unit = readable_unit(low)
    assert unit <= 1.0
    assert low / unit >= 0.001 * (1.0 - 1e-8)
    assert unit == 1.0 or low / unit < 1.0


def test_the_title_of_a_chart_names_its_unit() -> None:
    assert in_unit("East [m], 7 of 9 vehicles", 0.001) == "East [0.001 m], 7 of 9 vehicles"
    assert in_unit("note a", 1e-6) == "note a [1e-06]"


@pytest.mark.parametrize(("count", "suffix"), [(7, ""), (8, ", 7 of 8 vehicles"), (100, ", 7 of 100 vehicles")])
def test_a_chart_reports_omitted_vehicles(count: int, suffix: str) -> None:
    with open_station(scenery(count)) as station_page:
        station_page.show(1.0)
        station_page.show(2.0)
        titles = [chart.title for chart in station_page.parts(viser.GuiUplotHandle)]
        assert f"Speed [m/s]{suffix}" in titles
