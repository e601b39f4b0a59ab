"""CSMA/CA of IEEE 802.15.4: two radios that disturb each other."""

from typing import Any

import numpy as np
import pytest

from tests.support.netsim.csma154_runs import MS, NOISE_DBM, PHY, SILENT, US, World, at, levels, line
from vcmvsp.netsim.interfaces.medium import Fate
from vcmvsp.netsim.phy.ieee802154 import OqpskErrors


def hidden(left_dbm: float, right_dbm: float, *, later_us: int, sizes: tuple[int, int], **mac: Any) -> tuple[World, int]:
    """0 sends, and 2 begins ``later_us`` after it; also returned: when 0 begins."""
    world = World(line(left_dbm, right_dbm), **mac)
    offers = [(at(100 * MS, 0), 0, sizes[0]), (at(100 * MS + later_us * US, 2), 2, sizes[1])]
    for time_ns, sender, size in sorted(offers):
        world.offer(time_ns, sender, size=size, patience=1e-3)
    return world, 100 * MS


@pytest.mark.parametrize("later_us", [1, 500, 2000])
def test_hidden_nodes_collide_and_the_first_keeps_the_receiver(later_us: int) -> None:
    for right_dbm, first in ((-40.0, Fate.COLLISION), (-80.0, Fate.RECEIVED), (-10.0, Fate.COLLISION)):
        world, begin_ns = hidden(-40.0, right_dbm, later_us=later_us, sizes=(50, 50))
        by_start = sorted(world.finish().values(), key=lambda each: each.start_ns)
        assert by_start[0].start_ns == begin_ns
        assert by_start[1].start_ns == begin_ns + later_us * US
        assert by_start[0].fate[1] == first
        assert by_start[1].fate[1] == Fate.COLLISION  # however strong: the receiver is locked to the other


def test_of_frames_that_begin_together_the_stronger_is_received() -> None:
    world, _ = hidden(-60.0, -40.0, later_us=0, sizes=(50, 50))
    fates = {each.least_sinr[1] > 1.0: each.fate[1] for each in world.finish().values()}
    assert fates == {True: Fate.RECEIVED, False: Fate.COLLISION}


def test_hidden_nodes_do_not_collide_when_apart() -> None:
    world, _ = hidden(-40.0, -40.0, later_us=(50 + 17) * 32, sizes=(50, 50))
    assert [each.fate[1] for each in world.finish().values()] == [Fate.RECEIVED] * 2


@pytest.mark.parametrize(("forget", "sizes"), [(False, (50, 50)), (True, (50, 50)), (False, (100, 20)), (True, (100, 20))])
def test_hazards_of_the_pieces_add_up(forget: bool, sizes: tuple[int, int]) -> None:
    """Free for 40 bytes, then disturbed; the shorter frame ends before the first. ns-3.44 then forgets it."""
    errors, later_bytes = OqpskErrors(), 40
    total = sizes[0] + 17
    disturbed = min(total - later_bytes, sizes[1] + 17)
    if forget and disturbed < total - later_bytes:
        disturbed = 0
    power, other, noise = (10.0 ** (dbm / 10.0) for dbm in (NOISE_DBM + 3.0, NOISE_DBM + 1.0, NOISE_DBM))
    one, two = errors.bit_hazard(np.array([power / noise, power / (noise + other)]))
    hazard = 8 * ((total - disturbed) * one + disturbed * two)
    for factor, fate in ((1.0 + 1e-9, Fate.RECEIVED), (1.0 - 1e-9, Fate.COLLISION)):
        world = World(line(NOISE_DBM + 3.0, NOISE_DBM + 1.0), forget_interference=forget)
        offers = [(at(100 * MS, 0), 0), (at(100 * MS + 32 * later_bytes * US, 2), 2)]
        for time_ns, sender in sorted(offers):
            world.offer(time_ns, sender, size=sizes[sender // 2], patience=float(hazard) * factor)
        decided = min(world.finish().values(), key=lambda each: each.start_ns)
        expected = fate if disturbed or fate == Fate.RECEIVED else Fate.ERROR
        assert decided.fate[1] == expected
        assert decided.least_sinr[1] == pytest.approx(power / (noise + other))


@pytest.mark.parametrize(("after_us", "fate"), [(-1, Fate.TRANSMITTING), (191, Fate.TRANSMITTING), (192, Fate.RECEIVED)])
def test_a_radio_is_deaf_until_it_has_turned_round_again(after_us: int, fate: Fate) -> None:
    """1 sends; 0, whom 1 hears but who does not hear 1, begins so long after the end."""
    dbm = levels(2)
    dbm[1, 0] = SILENT
    world, end_ns = World(dbm), 100 * MS + PHY.air_time_ns(50)
    for time_ns, sender in sorted([(at(100 * MS, 1), 1), (at(end_ns + after_us * US, 0), 0)]):
        world.offer(time_ns, sender)
    decided = world.finish()
    assert max(decided.values(), key=lambda each: each.start_ns).fate[1] == fate


@pytest.mark.parametrize(("after_ns", "free"), [(0, True), (1, False), (67 * 32 * US, False), (67 * 32 * US + 1, True)])
def test_within_one_nanosecond_the_air_is_assessed_before_it_changes(after_ns: int, free: bool) -> None:
    """As if waves took their time: at its first instant a frame is not yet heard, at its last it still is."""
    world = World(levels(2))
    start_ns = 100 * MS + after_ns + 192 * US
    for time_ns, sender in sorted([(at(100 * MS, 0), 0), (at(start_ns, 1), 1)]):
        world.offer(time_ns, sender)
    last = max(world.finish().values(), key=lambda each: each.start_ns)
    assert (last.start_ns == start_ns) == free


def test_least_power_on_the_air_counts_as_busy() -> None:
    """10 dB above the sensitivity, for one who did not notice the frame's beginning."""
    for dbm, attempts in ((PHY.sensitivity_dbm + 10.01, 0), (PHY.sensitivity_dbm + 9.99, 1)):
        dbms = levels(3)
        dbms[0, 2] = dbms[2, 0] = dbm
        dbms[0, 1] = dbms[1, 0] = SILENT
        world = World(dbms, preamble_snr_db=30.0)
        world.offer(0, 0, size=20_000)  # on the air for 0.7 s
        number = world.offer(50 * MS, 2)
        assert world.finish()[number].attempts == attempts
