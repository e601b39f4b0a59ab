"""`[bridge]`: gateways that a run can combine."""

from pathlib import Path

import pytest

from tests.support.cosim.command_line import two_cars, vcmvsp_command

DOORS = "[bridge.ip]\n[bridge.lab]\nkind = {kind!r}\n"


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("kind", ["ip", "vcmvsp.netsim.bridge.gateways.ip.gateway:Ip"])
def test_a_second_gateway_of_a_single_kind_is_refused_with_its_key(tmp_path: Path, kind: str) -> None:
    (tmp_path / "s.toml").write_text(two_cars() + DOORS.format(kind=kind))
    outcome = vcmvsp_command("check", "s.toml")
    assert (outcome.code, outcome.out) == (2, "")
    problem = f"bridge.lab: a run has at most one gateway of kind {kind}, and bridge.ip is one: leave one out"
    assert problem in outcome.err
    assert "s.toml" in outcome.err


def test_other_kinds_can_be_combined(tmp_path: Path) -> None:
    doors = "[bridge.udp]\n[bridge.lab]\nkind = 'udp'\nfirst_port = 48000\n[bridge.net]\nkind = 'ip'\n"
    (tmp_path / "s.toml").write_text(two_cars() + doors)
    assert vcmvsp_command("check", "s.toml").code == 0
