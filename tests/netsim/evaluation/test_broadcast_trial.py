"""Trials of the channel alone: conservation of frames, repeatability, and independence of batch sizes."""

import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.netsim.channels import make_channel
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.reproduction.validation import medium_access
from vcmvsp.cosim.tables.schema import RADIO_SCHEMA, RunFacts, radio_table, write_table
from vcmvsp.cosim.types import FrameReport
from vcmvsp.netsim.evaluation import broadcast_trial
from vcmvsp.netsim.evaluation.broadcast_trial import Delays
from vcmvsp.netsim.evaluation.files import RowFile, read_positions
from vcmvsp.netsim.interfaces.layers import Floats

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _as_it_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs plain Python code: compiling takes longer than all tests here."""
    monkeypatch.setenv("VCMVSP_COMPILED", "0")


def places(count: int, width_m: float = 150.0) -> Floats:
    square = np.random.default_rng(5).uniform(0.0, width_m, (count, 2))
    return np.column_stack([square, np.zeros(count)])


def files(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def plan(position: Floats, **changes: Any) -> broadcast_trial.TrialTraffic:
    settings = {"rate_hz": 10.0, "size_bytes": 100, "duration_s": 1.0, "seed": 3, **changes}
    return broadcast_trial.TrialTraffic(waypoints=broadcast_trial.Waypoints.fixed(position), **settings)


def facts_of(traffic: broadcast_trial.TrialTraffic) -> RunFacts:
    return RunFacts(scenario="trial", seed=traffic.seed, end_ns=traffic.end_ns, vehicles=traffic.names)


CHANNELS: list[dict[str, Any]] = [
    {"name": "ideal", "loss": {"probability": 0.3}, "delay": {"seconds": 0.01, "jitter_s": 0.005}},
    {"name": "wifi-b-1", "shadowing": {"sigma_db": 4.0}},
    {"name": "wifi-b-1", "mac": {"kind": "dcf"}},
    {"name": "wifi-g-54", "mac": {"kind": "dcf"}, "fading": {"kind": "nakagami", "m": 1.0}},
]


# --- sending ----------------------------------------------------------------------------------------------------------------


def test_every_radio_sends_once_a_period_until_the_end() -> None:
    """Also where the period is no whole number of nanoseconds."""
    for rate_hz, duration_s in ((10.0, 1.0), (3.0, 2.1), (0.4, 1.0)):
        traffic = plan(places(40), rate_hz=rate_hz, duration_s=duration_s)
        sent = list(traffic.sendings())
        times = [time_ns for time_ns, _ in sent]
        assert times == sorted(times)
        assert times[0] >= 0
        assert times[-1] < traffic.end_ns
        for row, phase_ns in enumerate(traffic.phases_ns()):
            own = [time_ns for time_ns, sender in sent if sender == row]
            assert len(own) == max(0, np.ceil((duration_s - phase_ns / 1e9) * rate_hz))
            assert np.allclose(own, phase_ns + np.arange(len(own)) * 1e9 / rate_hz, atol=1.0, rtol=0.0)


def test_phases_are_uniform_in_the_period() -> None:
    """Kolmogorov-Smirnov at 0.1 %: 1.95 / sqrt(n); and the mean within 4 standard errors."""
    phases = np.sort(plan(np.zeros((2000, 3)), rate_hz=4.0).phases_ns()) / (SECOND_NS / 4)
    assert phases[0] >= 0.0
    assert phases[-1] < 1.0
    assert np.abs(phases - np.arange(2000) / 2000).max() < 1.95 / np.sqrt(2000)
    assert np.mean(phases) == pytest.approx(0.5, abs=4.0 / np.sqrt(12 * 2000))


def test_phases_differ_from_seed_to_seed_and_another_radio_changes_none() -> None:
    assert plan(places(6)).phases_ns() == plan(places(7)).phases_ns()[:6]
    assert not set(plan(places(20), seed=1).phases_ns()) & set(plan(places(20), seed=2).phases_ns())


# --- rules of sending -------------------------------------------------------------------------------------------------------


def gaps_ns(traffic: broadcast_trial.TrialTraffic, row: int) -> Floats:
    return np.diff([time_ns for time_ns, sender in traffic.sendings() if sender == row]).astype(np.float64)


def test_jittered_periods_are_uniform_around_the_period() -> None:
    """First frame as with periodic traffic; Kolmogorov-Smirnov at 0.1 %: 1.95 / sqrt(n)."""
    traffic = plan(places(3), kind="jitter", jitter=0.2, rate_hz=20.0, duration_s=100.0)
    sent = list(traffic.sendings())
    assert [time_ns for time_ns, _ in sent] == sorted(time_ns for time_ns, _ in sent)
    assert [next(time_ns for time_ns, row in sent if row == each) for each in range(3)] == traffic.phases_ns()
    for row in range(3):
        shares = np.sort((gaps_ns(traffic, row) * 20.0 / SECOND_NS - 0.8) / 0.4)
        assert -1e-6 < shares[0] < shares[-1] < 1.0 + 1e-6
        assert np.abs(shares - np.arange(len(shares)) / len(shares)).max() < 1.95 / np.sqrt(len(shares))


def test_frames_of_a_poisson_process_have_exponential_gaps_also_before_the_first() -> None:
    traffic = plan(places(300), kind="poisson", rate_hz=20.0, duration_s=10.0)
    first = [next(time_ns for time_ns, row in traffic.sendings() if row == each) for each in range(0, 300, 10)]
    assert np.mean(first) == pytest.approx(SECOND_NS / 20.0, rel=4.0 / np.sqrt(len(first)))
    sent = [row for _, row in traffic.sendings()]
    assert len(sent) == pytest.approx(300 * 200, abs=4.0 * np.sqrt(300 * 200))
    gaps = np.sort(gaps_ns(plan(places(2), kind="poisson", rate_hz=20.0, duration_s=200.0), 0)) * 20.0 / SECOND_NS
    assert np.abs(1.0 - np.exp(-gaps) - np.arange(len(gaps)) / len(gaps)).max() < 1.95 / np.sqrt(len(gaps))


@pytest.mark.parametrize("kind", ["jitter", "poisson"])
def test_another_radio_changes_no_times_of_the_others(kind: str) -> None:
    few, many = (list(plan(places(count), kind=kind).sendings()) for count in (4, 5))
    assert few == [each for each in many if each[1] < 4]


def test_a_saturated_radio_alone_is_never_idle() -> None:
    """Ideal access: one frame per air time, until the end of sending."""
    counts = broadcast_trial.run(make_channel("wifi-b-1", mac={"kind": "ideal"}), plan(places(2, 10.0), kind="saturated"))
    assert counts["frames"] == 2 * np.ceil(1.0 / 1280e-6)  # 100 bytes of payload
    assert counts["delay_s"]["mean"] == pytest.approx(1280e-6)


@pytest.mark.parametrize("count", [3, 10])
def test_saturated_unicast_to_one_radio_is_bianchis(count: int) -> None:
    """Equal levels: no frame survives a collision; see `reproduction.validation.medium_access`."""
    channel = make_channel("wifi-b-11", mac={"kind": "dcf"}, path_loss=dict(medium_access.EQUAL))
    reports: list[FrameReport] = []
    traffic = plan(places(count + 1), kind="saturated", to="v0", size_bytes=1000, duration_s=2.0)
    counts = broadcast_trial.run(channel, traffic, sink=reports.append)
    tau, air_ns = medium_access.sending_chance(count), reports[0].air_time_ns
    idle, alone = (1 - tau) ** count, count * tau * (1 - tau) ** (count - 1)
    success_ns = air_ns + medium_access.SIFS_NS + medium_access.ACK_NS + medium_access.DIFS_NS
    slot_ns = idle * medium_access.SLOT_NS + alone * success_ns + (1 - idle - alone) * (air_ns + medium_access.DIFS_NS)
    assert counts["receptions"] / 2.0 == pytest.approx(1e9 * alone / slot_ns, rel=0.03)


@pytest.mark.parametrize("kind", ["periodic", "jitter", "poisson", "saturated"])
@pytest.mark.parametrize("channel", CHANNELS)
def test_unicast_frames_have_one_receiver_and_repeat(kind: str, channel: dict[str, Any]) -> None:
    found, is_quick = [], kind == "saturated" and channel["name"] == "ideal"  # a frame of each radio per microsecond
    for _ in range(2):
        reports: list[FrameReport] = []
        traffic = plan(places(5), kind=kind, to="v2", rate_hz=30.0, duration_s=0.001 if is_quick else 0.2)
        counts = broadcast_trial.run(make_channel(**channel), traffic, sink=reports.append)
        assert {report.receivers for report in reports} == {("v2",)}
        assert {report.sender for report in reports} == {"v0", "v1", "v3", "v4"}
        assert counts["receptions"] + sum(counts["losses"].values()) == counts["frames"] == len(reports)
        found.append([(report.frame, report.sender, report.sent_ns, report.outcome) for report in reports])
    assert found[0] == found[1]


@pytest.mark.parametrize("kind", ["periodic", "saturated"])
def test_radios_are_where_their_paths_lead_at_the_time_of_sending(kind: broadcast_trial.Kind, tmp_path: Path) -> None:
    """A rests, B waits until 0.5 s, then moves away at 20 m/s until 1.5 s."""
    (tmp_path / "p.csv").write_text("t,name,x,y,z\n0.5,b,3,4,0\n0,a,0,0,0\n1.5,b,15,20,0\n")
    reports: list[FrameReport] = []
    traffic = broadcast_trial.TrialTraffic(
        waypoints=read_positions(tmp_path / "p.csv"), rate_hz=50.0, size_bytes=100, duration_s=2.0, kind=kind
    )
    assert traffic.names == ("b", "a")
    broadcast_trial.run(make_channel("wifi-b-1"), traffic, sink=reports.append)
    assert len(reports) >= 200
    times_s = np.array([report.sent_ns for report in reports]) / 1e9
    distances_m = [float(report.distance_m[0]) for report in reports]
    assert distances_m == pytest.approx(5.0 + 20.0 * np.clip(times_s - 0.5, 0.0, 1.0))


# --- counting ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channel", CHANNELS)
def test_every_frame_is_received_or_lost_at_every_receiver(channel: dict[str, Any]) -> None:
    reports: list[FrameReport] = []
    traffic = plan(places(12))
    counts = broadcast_trial.run(make_channel(**channel), traffic, sink=reports.append)
    assert counts["frames"] == 120 == len(reports)
    assert counts["receptions"] + sum(counts["losses"].values()) == 120 * 11
    outcomes = [outcome for report in reports for outcome in report.outcome]
    assert counts["losses"] == {cause: outcomes.count(cause) for cause in sorted(set(outcomes) - {"received"})}
    assert counts["delivery_ratio"] == outcomes.count("received") / len(outcomes)
    delays = np.concatenate([report.received_ns[report.received_ns >= 0] - report.sent_ns for report in reports]) / 1e9
    expected = {"mean": np.mean(delays), **{f"p{p}": np.percentile(delays, p) for p in (50, 95, 99)}}
    assert counts["delay_s"] == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("channel", CHANNELS)
def test_the_same_seed_gives_the_same_and_another_seed_something_else(channel: dict[str, Any], tmp_path: Path) -> None:
    def once(name: str, seed: int) -> tuple[dict[str, Any], bytes]:
        traffic, path = plan(places(8), seed=seed), tmp_path / name
        with RowFile(path, facts_of(traffic), rows=100) as rows:
            counts = broadcast_trial.run(make_channel(**channel), traffic, sink=rows.add)
        del counts["cpu_s"]
        return counts, path.read_bytes()

    assert once("a", 1) == once("b", 1)
    assert once("a", 1)[1] != once("b", 2)[1]


def test_without_anybody_else_there_is_nothing_to_receive() -> None:
    for channel in CHANNELS:
        counts = broadcast_trial.run(make_channel(**channel), plan(places(1)))
        assert counts["frames"] == 10
        assert (counts["receptions"], counts["delivery_ratio"], counts["losses"]) == (0, None, {})
        assert counts["delay_s"] == {"mean": None, "p50": None, "p95": None, "p99": None}


def test_a_duration_shorter_than_all_phases_has_no_frames() -> None:
    counts = broadcast_trial.run(make_channel("ideal"), plan(places(3), rate_hz=1e-6, duration_s=1e-6))
    assert (counts["frames"], counts["delivery_ratio"]) == (0, None)


def test_progress_never_goes_back_nor_beyond_the_end() -> None:
    calls: list[tuple[int, int]] = []
    broadcast_trial.run(make_channel("ideal"), plan(places(20)), progress=lambda now_ns, end_ns: calls.append((now_ns, end_ns)))
    assert calls == sorted(calls)
    assert calls
    assert all(now_ns < end_ns == SECOND_NS for now_ns, end_ns in calls)


# --- delays -----------------------------------------------------------------------------------------------------------------


@given(
    st.lists(st.tuples(st.integers(0, 10**12), st.integers(1, 4)), min_size=1, max_size=40),
    st.lists(st.integers(0, 100), max_size=40),
)
def test_percentiles_cover_all_delays(same: list[tuple[int, int]], each: list[int]) -> None:
    delays = Delays()
    values, counts = np.array(same, np.int64).T
    delays.add(values, counts)
    delays.add(np.array(each, np.int64))
    everything = np.array([value for value, count in same for _ in range(count)] + each) / 1e9
    assert delays.percentiles_s(0, 37, 50, 95, 99, 100) == pytest.approx(
        np.percentile(everything, [0, 37, 50, 95, 99, 100]), rel=1e-12, abs=1e-18
    )
    assert delays.mean_s() == pytest.approx(np.mean(everything), rel=1e-12)


def test_delays_that_come_again_and_again_stay_exact() -> None:
    values = np.random.default_rng(1).integers(0, 40, 1000)
    delays = Delays(kept=100)
    for begin in range(0, 1000, 50):
        delays.add(values[begin : begin + 50])
        assert delays.mean_s() is not None  # writes them: 40 of them held, and 40 more
    assert delays.percentiles_s(5, 50, 99) == pytest.approx(np.percentile(values / 1e9, [5, 50, 99]), rel=1e-12)


@given(st.lists(st.integers(0, 2**62), min_size=4, max_size=200))
def test_percentiles_of_too_many_delays_are_right_within_half_a_bin(values: list[int]) -> None:
    delays = Delays(kept=2)
    for begin in range(0, len(values), 3):
        delays.add(np.array(values[begin : begin + 3], np.int64))
        assert delays.mean_s() is not None  # writes them
    found = delays.percentiles_s(0, 50, 95, 100)
    assert found == pytest.approx(np.percentile(np.array(values) / 1e9, [0, 50, 95, 100]), rel=1.01 * 2.0**-13, abs=1e-18)


# --- rows -------------------------------------------------------------------------------------------------------------------


def test_rows_equal_a_runs_in_order_of_sending(tmp_path: Path) -> None:
    """One group gives the same bytes, many groups the same rows, also where frames are decided out of order."""
    traffic, reports = plan(places(10), rate_hz=300.0, duration_s=0.1), list[FrameReport]()
    broadcast_trial.run(make_channel("wifi-b-1", mac={"kind": "dcf"}), traffic, sink=reports.append)
    numbers = [report.frame for report in reports]
    assert numbers != sorted(numbers)
    whole = radio_table(reports, facts_of(traffic))
    write_table(whole, tmp_path / "whole")
    for rows, name in ((10**9, "one"), (100, "many")):
        with RowFile(tmp_path / name, facts_of(traffic), rows=rows) as file:
            for report in reports:
                file.add(report)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "whole").read_bytes()
    many = pq.ParquetFile(tmp_path / "many")
    assert many.num_row_groups > 10
    assert many.read().to_pylist() == whole.to_pylist()
    assert many.schema_arrow.equals(RADIO_SCHEMA)
    assert files(tmp_path) == ["many", "one", "whole"]


def test_an_aborted_run_leaves_the_earlier_file(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    path.write_text("old")

    def stop(now_ns: int, end_ns: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), RowFile(path, facts_of(plan(places(3))), rows=1) as file:
        broadcast_trial.run(make_channel("ideal"), plan(places(3)), sink=file.add, progress=stop)
    assert files(tmp_path) == ["rows.parquet"]
    assert path.read_text() == "old"


def test_a_pipe_is_refused_and_not_replaced(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "rows")
    reader = os.open(tmp_path / "rows", os.O_RDWR)
    with pytest.raises(UsageError, match="cannot write"), RowFile(tmp_path / "rows", facts_of(plan(places(3)))):
        pass
    os.close(reader)
    assert (tmp_path / "rows").is_fifo()


@pytest.mark.parametrize(("name", "problem"), [(".", "is a folder"), ("no/rows.parquet", "does not exist; create it first")])
def test_a_place_where_no_file_can_be_is_refused(name: str, problem: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=problem), RowFile(tmp_path / name, facts_of(plan(places(3)))):
        pass
