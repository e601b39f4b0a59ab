"""What the programs are that ours is measured beside, and what a table says where they are not there."""

import sys
from pathlib import Path

import pytest

from bench import drones, messages, radio
from bench.asked import SilentError, program
from bench.messages import IDEAL, LEVELS, LOSS, Counter, talk
from bench.peers.simpy_air import talked
from vcmvsp.cosim.runs import api

HERE = Path(sys.executable)
NOWHERE = Path("nowhere/bin/python")


def test_a_program_works_whenever_it_is_asked() -> None:
    with program("simpy_air", HERE, agents=3, span_s=1.0) as stretch:
        assert [stretch() > 0.0 for _ in range(3)] == [True] * 3


def test_a_program_that_does_not_answer_says_why() -> None:
    with pytest.raises(SilentError, match=r"No module named bench\.peers\.nothing"), program("nothing", HERE):
        pass


@pytest.mark.parametrize("count", drones.MOST)
def test_a_row_without_its_peer_says_what_to_do(count: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drones, "PYTHON", NOWHERE)
    for peer in drones.PEERS:
        row = drones._row(count, peer)
        assert row.holds
        assert row.other == "not measured: it is not installed: make nowhere/.ready"


def test_so_does_a_row_of_messages() -> None:
    row = messages.beside(10, IDEAL, "nothing", "it", "gradysim_broadcast", NOWHERE, 2.0)
    assert row.other.endswith("make nowhere/.ready")


def test_so_do_rows_of_the_radio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NS3_PREFIX", str(tmp_path))
    monkeypatch.setenv("NS3_RESULTS", str(tmp_path))
    monkeypatch.setattr(radio, "_thousand", lambda: pytest.fail("it is to be asked for only"))
    rows = radio.rows()
    for _ in range(5):
        row = next(rows)
        assert row.holds
        assert row.other.startswith("not measured: no ns-3: make .ns3/.ready")


@pytest.mark.parametrize("channel", [IDEAL, LEVELS], ids=["losses", "levels"])
def test_of_what_everybody_broadcasts_a_fifth_is_lost(channel: dict[str, object]) -> None:
    duration_s, count = 10.0, 5
    agents = {f"car{n}": Counter() for n in range(count)}
    api.run(talk(count, channel, duration_s), agents=agents, mcap=False)
    sent = 10 * duration_s - 1  # what is sent at the last tick arrives after it
    shares = [each.heard / (sent * (count - 1)) for each in agents.values()]
    assert shares == pytest.approx([1.0 - LOSS] * count, abs=0.08)


@pytest.mark.parametrize("loss", [0.0, LOSS, 1.0])
def test_the_programme_on_simpy_loses_what_it_is_told_to(loss: float) -> None:
    count, span_s = 5, 20.0
    heard = sum(node.heard for node in talked(count, span_s, loss))
    assert heard / (10 * span_s * count * (count - 1)) == pytest.approx(1.0 - loss, abs=0.03)
