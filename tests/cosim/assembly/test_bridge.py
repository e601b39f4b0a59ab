"""`[bridge]`: gateways that a run can combine."""

from pathlib import Path

import pytest

from tests.support.cosim.command_line import assert_refused, two_cars, vcmvsp_command

DOORS = "[bridge.ip]\n[bridge.lab]\nkind = {kind!r}\n"


@pytest.mark.parametrize("kind", ["ip", "vcmvsp.netsim.bridge.gateways.ip.gateway:Ip"])
def test_a_second_gateway_of_a_single_kind_is_refused_with_its_key(here: Path, kind: str) -> None:
    (here / "s.toml").write_text(two_cars() + DOORS.format(kind=kind))
    problem = f"bridge.lab: a run has at most one gateway of kind {kind}, and bridge.ip is one: leave one out"
    assert_refused(vcmvsp_command("check", "s.toml"), "s.toml", problem)


def test_other_kinds_can_be_combined(here: Path) -> None:
    doors = "[bridge.udp]\n[bridge.lab]\nkind = 'udp'\nfirst_port = 48000\n[bridge.net]\nkind = 'ip'\n"
    (here / "s.toml").write_text(two_cars() + doors)
    assert vcmvsp_command("check", "s.toml").code == 0
