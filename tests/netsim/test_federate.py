"""Mean levels of all links, their reports to agents, and the choice of compiled code."""

from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
import pytest

from tests.support.cosim.receptions import receptions_in
from tests.support.netsim.channels import at_rest, make_channel
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.compiled.machine_code import Core, Run
from vcmvsp.cosim.federate import Event, RunInfo, Step
from vcmvsp.cosim.types import Array, FrameReport, Message, Reception, States
from vcmvsp.netsim.federate import RadioFederate

MS = 1_000_000
NAMES = ("a", "b", "c")
CONTENDED: dict[str, Any] = {"mac": {"kind": "dcf"}, "loss": {"probability": 0.3}}
RUN = RunInfo(scenario="test", seed=4, duration_ns=10**10, vehicles=NAMES)


def states(time_ns: int, *x: float) -> Event:
    return Event("world/states", time_ns, at_rest(NAMES[: len(x)], [(each, 0.0, 0.0) for each in x]))


def sends(time_ns: int, sender: str, to: str | None = None) -> Event:
    return Event(f"{sender}/send", time_ns, Message(sender=sender, body={"t": time_ns}, size_bytes=100, to=to))


def frames(step: Step) -> list[FrameReport]:
    return [event.value for event in step.events if isinstance(event.value, FrameReport)]


def started(preset: str = "wifi-b-1", run: RunInfo = RUN, *, own: dict[str, Any] | None = None, **layers: Any) -> RadioFederate:
    federate = RadioFederate(make_channel(preset, **layers), **own or {})
    assert federate.start(run) is None
    return federate


@pytest.fixture
def radio() -> RadioFederate:
    return started()


def test_a_frame_gives_one_report_and_one_reception_per_receiver(radio: RadioFederate) -> None:
    sent = sends(50 * MS, "a")
    step = radio.step(50 * MS, [states(40 * MS, 0.0, 20.0, 500.0), sent])
    receptions, report = step.events
    assert isinstance(sent.value, Message)
    assert step.next_ns is None
    assert (report.key, report.time_ns) == ("radio/frame", 50 * MS)
    assert isinstance(report.value, FrameReport)
    assert report.value.outcome == ("received", "below sensitivity")
    assert (receptions.key, receptions.time_ns) == ("radio/receptions", 50 * MS)
    times, level_dbm = {"sent_ns": 50 * MS, "received_ns": 50 * MS + 1_280_000}, report.value.rssi_dbm[0].item()
    assert list(receptions_in([receptions])) == [("b", Reception(message=sent.value, rssi_dbm=level_dbm, **times))]


def test_a_reader_that_a_reception_wakes_gets_each_when_it_arrives() -> None:
    step = started(own={"woken": ("b",)}).step(50 * MS, [states(40 * MS, 0.0, 20.0, 30.0), sends(50 * MS, "a")])
    batch, woken, _ = step.events
    assert (woken.key, woken.time_ns) == ("b/heard", 50 * MS + 1_280_000)
    assert [("b", woken.value)] == [each for each in receptions_in([batch]) if each[0] == "b"]


@pytest.mark.parametrize("least_dbm", [-75.0, -85.0])
def test_reports_leave_out_receivers_below_a_level_that_lost_the_frame(least_dbm: float) -> None:
    """Under Rayleigh fading some weak levels are received and some strong ones lost; agents get the same messages."""
    names = tuple(f"v{n}" for n in range(12))
    run = msgspec.structs.replace(RUN, vehicles=names)
    team = at_rest(names, [(14.0 * n, 0.0, 0.0) for n in range(12)])
    fading, left_out = {"kind": "rayleigh"}, 0
    pair = [started("wifi-b-1", run, own={"reported_from_dbm": least}, fading=fading) for least in (None, least_dbm)]
    for tick, sender in enumerate(names, 1):
        sent = [Event("world/states", tick * MS, team), sends(tick * 20 * MS, sender)]
        steps = [federate.step(tick * 20 * MS, sent) for federate in pair]
        assert list(receptions_in(steps[0].events)) == list(receptions_in(steps[1].events))
        (all_,), (near,) = map(frames, steps)
        reported = (all_.rssi_dbm >= least_dbm) | (all_.received_ns >= 0)
        reported[all_.rssi_dbm.argmax()] = True
        assert near.receivers == tuple(np.array(all_.receivers)[reported])
        assert near.outcome == tuple(np.array(all_.outcome)[reported])
        for column in ("rssi_dbm", "distance_m", "received_ns", "snr_db", "fading_db", "path_loss_db"):
            np.testing.assert_array_equal(getattr(near, column), getattr(all_, column)[reported])
        left_out += len(reported) - reported.sum()
    assert left_out


def test_the_newest_positions_count(radio: RadioFederate) -> None:
    inbox = [states(0, 0.0, 20.0, 30.0), states(10 * MS, 0.0, 500.0, 30.0), sends(10 * MS, "a")]
    assert frames(radio.step(10 * MS, inbox))[0].distance_m.tolist() == [500.0, 30.0]
    assert frames(radio.step(20 * MS, [sends(20 * MS, "a")]))[0].distance_m.tolist() == [500.0, 30.0]
    later = radio.step(30 * MS, [states(30 * MS, 0.0, 5.0, 30.0), sends(30 * MS, "b")])
    assert frames(later)[0].distance_m.tolist() == [5.0, 25.0]


def test_frames_enter_in_the_order_in_which_they_were_handed_over(radio: RadioFederate) -> None:
    step = radio.step(0, [states(0, 0.0, 5.0, 9.0), sends(0, "c"), sends(0, "a"), sends(0, "a", to="c")])
    assert [(report.frame, report.sender, report.receivers) for report in frames(step)] == [
        (0, "c", ("a", "b")),
        (1, "a", ("b", "c")),
        (2, "a", ("c",)),
    ]
    assert frames(step)[2].received_ns.tolist() == [2 * 1_280_000]  # a's second frame waits for its first


def test_all_events_lie_in_the_present_or_the_future() -> None:
    radio = started("zigbee", delay={"seconds": 0.01, "jitter_s": 0.02}, loss={"probability": 0.3})
    radio.step(0, [states(0, 0.0, 5.0, 9.0)])
    for k in range(200):
        step = radio.step(k * MS, [sends(k * MS, name) for name in NAMES])
        assert {event.time_ns for event in step.events} == {k * MS}
        assert all(each.received_ns > each.sent_ns == k * MS for _, each in receptions_in(step.events))


def test_sending_before_any_position_is_known_is_an_error(radio: RadioFederate) -> None:
    with pytest.raises(ValueError, match="a sends before the first message of world/states"):
        radio.step(0, [sends(0, "a")])


def code_is_had(patch: pytest.MonkeyPatch, on_load: Callable[[], None]) -> None:
    """Plain code stands in for compiled code, not loaded by earlier tests; the list grows with each load."""

    loaded: list[Core] = []

    def load(core: Core) -> Run:
        on_load()
        loaded.append(core)
        return core.interpreted

    patch.setattr("vcmvsp.netsim.mac.dcf.medium.available", lambda: True)
    patch.setattr("vcmvsp.cosim.compiled.machine_code.available", lambda: True)
    patch.setattr(Core, "is_loaded", property(lambda core: core in loaded))
    patch.setattr(Core, "compiled", property(load))


@pytest.mark.parametrize("programs", [False, True])
def test_at_wall_pace_nothing_is_compiled_but_at_the_start_and_only_where_programs_may_send(
    programs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Compiling would stop the run for a second; with code loaded beforehand, the outcomes are equal."""
    compiled: list[int] = []
    code_is_had(monkeypatch, lambda: compiled.append(1))
    monkeypatch.setattr("vcmvsp.netsim.mac.dcf.medium.COMPILE_AFTER_S", 1.0)
    monkeypatch.setattr("vcmvsp.netsim.mac.dcf.medium.LOAD_S", 1.0)
    monkeypatch.setattr("vcmvsp.netsim.mac.dcf.medium.FRAME_S", 0.1)

    def fates(*, paced: bool) -> list[tuple[str, ...]]:
        run = msgspec.structs.replace(RUN, paced=paced)
        radio = started("wifi-b-1", run, own={"programs": programs}, **CONTENDED)
        before = len(compiled)
        radio.step(0, [states(0, 0.0, 20.0, 60.0)])
        found = []
        for now_ns in range(MS, 60 * MS, 2 * MS):
            step = radio.step(now_ns, [sends(now_ns, "a")])
            found += [report.outcome for report in frames(step)]
        assert not paced or len(compiled) in ((before, before + 1) if programs else (0,))
        return found

    assert fates(paced=True) == fates(paced=False)
    assert compiled


@pytest.mark.parametrize("seconds", [1, 60])
def test_the_rate_of_the_first_frames_decides_on_compiled_code(seconds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten frames a second: in a minute loading pays, in a second not; the outcomes are equal."""
    loaded_at: list[int] = []
    fates: list[list[tuple[str, ...]]] = []
    code_is_had(monkeypatch, lambda: loaded_at.append(len(fates[-1])))
    monkeypatch.setattr(Core, "is_cached", property(lambda _: True))
    monkeypatch.setattr("vcmvsp.netsim.federate.FORECAST_AT", 5)
    for duration_s in (seconds, 1):
        radio = started("wifi-b-1", msgspec.structs.replace(RUN, duration_ns=duration_s * SECOND_NS), **CONTENDED)
        radio.step(0, [states(0, 0.0, 20.0, 60.0)])
        fates.append([])
        for now_ns in range(100 * MS, 1000 * MS, 100 * MS):
            fates[-1] += [report.outcome for report in frames(radio.step(now_ns, [sends(now_ns, "a")]))]
    assert fates[0] == fates[1]
    assert loaded_at == ([] if seconds == 1 else [3])


def levels(radio: RadioFederate, here: Event) -> Array:
    assert isinstance(here.value, States)
    return radio.levels_dbm(here.value)


def test_mean_levels_equal_those_of_sent_frames_and_need_none() -> None:
    radio = started(shadowing={"sigma_db": 4.0})
    here = states(0, 0.0, 20.0, 300.0)
    far, near = levels(radio, states(0, 0.0, 40.0, 300.0)), levels(radio, here)
    assert far[0, 1] < near[0, 1]
    assert far[0, 2] == near[0, 2]
    assert np.isnan(np.diagonal(near)).all()
    for report in frames(radio.step(0, [here, *(sends(0, name) for name in NAMES)])):
        columns = [NAMES.index(name) for name in report.receivers]
        assert near[NAMES.index(report.sender), columns].tolist() == report.rssi_dbm.tolist()


def test_asking_for_mean_levels_changes_no_frame() -> None:
    def run(*, ask: bool) -> str:
        radio, here = started(shadowing={"sigma_db": 4.0}, **CONTENDED), states(0, 0.0, 20.0, 60.0)
        radio.step(0, [here])
        found = []
        for k in range(60):
            now_ns = k * 50 * MS
            due = radio.step(now_ns, [sends(now_ns, name) for name in NAMES]).next_ns
            while due is not None and due < now_ns + 50 * MS:
                if ask:  # while frames wait and are on the air
                    levels(radio, here)
                step = radio.step(due, [])
                found += frames(step)
                due = step.next_ns
        return repr(found)

    assert run(ask=True) == run(ask=False)
