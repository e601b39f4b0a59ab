"""Hosts on other machines: with certificates, over an interrupted network, the same bytes as in one process."""

import re
import subprocess
import threading
import time
from pathlib import Path

import pytest

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import Forwarder, Stage, exit_of, output_at_exit, staged, wait_for
from tests.support.cosim.teams import ELSEWHERE, FOLLOWER, HERE, LEADER, team
from vcmvsp.agents import host_process
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.security import authority, certificates

pytestmark = [pytest.mark.processes, pytest.mark.sockets]


def far(duration_s: float) -> str:
    """The scenario of a leader in the run and two followers on remote hosts."""
    agents = LEADER + HERE, FOLLOWER + ELSEWHERE, FOLLOWER + ELSEWHERE
    return team("far", *agents, duration_s=duration_s, loss=0.3, deadline_s=20.0, join_timeout_s=60.0)


class Place(Stage):
    """A folder with keys and a scenario, and its processes."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        authority.init(folder / "keys")

    def keys(self, *vehicles: str, as_: str) -> str:
        return authority.issue(self.folder / "keys", as_, vehicles, out=self.folder).path.name

    def run(self, duration: float, *more: str) -> subprocess.Popen[str]:
        (self.folder / "far.toml").write_text(far(duration))
        listen = ["--listen", f"tls/127.0.0.1:{self.port}", "--keys", "keys"]
        return self.start("run", "far.toml", *listen, "--out", "out", *more)

    def host(self, vehicle: str, keys: str, port: int) -> subprocess.Popen[str]:
        return self.start("agent", "--vehicle", vehicle, "--connect", f"tls/127.0.0.1:{port}", "--keys", keys)

    def reference(self, latency_s: float = 0.0) -> str:
        settings = {"agents.latency_s": latency_s}
        return vcmvsp.run(self.folder / "far.toml", set=settings, agents="inprocess", mcap=False).metrics["digest"]


place = staged(Place)


def test_two_machines_with_certificates_give_the_bytes_of_one_process(place: Place) -> None:
    one, two = place.keys("car2", as_="one"), place.keys("car3", as_="two")
    run = place.run(5.0)
    hosts = [place.host("car2", one, place.port), place.host("car3", two, place.port)]
    assert exit_of(run)[0] == 0
    assert [exit_of(host)[0] for host in hosts] == [0, 0]
    assert place.digest() == place.reference()


def test_a_certificate_is_valid_only_for_its_vehicles(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Refused by the host itself because of its file; if this is circumvented, by the run, which reports it."""
    car2_keys, car3_keys = place.keys("car2", as_="one"), place.keys("car3", as_="two")
    run = place.run(5.0)
    output = output_at_exit(2, place.host("car3", car2_keys, place.port))
    assert "one.keys: is for car2, not for car3" in output
    monkeypatch.setattr(certificates.Bundle, "speaks_for", lambda *_: None)
    refusal = "the certificate of 'one' is for car2, not for car3"
    with pytest.raises(UsageError, match=f"the run rejects this host: {refusal}"):
        host_process.host(f"tls/127.0.0.1:{place.port}", ("car3",), keys=place.folder / car2_keys)
    hosts = [place.host("car2", car2_keys, place.port), place.host("car3", car3_keys, place.port)]
    output = output_at_exit(0, run)
    assert f"rejected a host with the certificate of one: {refusal}" in output
    assert [exit_of(host)[0] for host in hosts] == [0, 0]


@pytest.mark.parametrize("latency_s", [0.0, 0.45])
def test_a_cut_that_heals_within_the_deadline_loses_nothing(latency_s: float, place: Place) -> None:
    """With a latency, several questions are open when the link breaks, and some may arrive out of order afterwards."""
    both = place.keys("car2", "car3", as_="both")
    run = place.run(3.0, "--realtime", "--set", f"agents.latency_s={latency_s}")
    cuts, wires = (Forwarder.freeze, Forwarder.reset), [Forwarder(place.port), Forwarder(place.port)]
    hosts = [place.host(vehicle, both, wire.port) for vehicle, wire in zip(("car2", "car3"), wires, strict=True)]
    wait_for(place.out / "run.mcap")
    time.sleep(0.5)
    cutting = [threading.Thread(target=cut, args=(wire, 2.0)) for cut, wire in zip(cuts, wires, strict=True)]
    for each in cutting:
        each.start()
    ends = [exit_of(each) for each in (run, *hosts)]
    for each, wire in zip(cutting, wires, strict=True):
        each.join()
        wire.close()
    assert [code for code, _ in ends] == [0, 0, 0], ends
    assert place.digest() == place.reference(latency_s)
    assert place.written("about.json")["lateness"]["max_s"] > 1.0  # the cuts had an effect


def test_remote_hosts_need_certificates(place: Place) -> None:
    (place.folder / "far.toml").write_text(far(1.0))
    run = ("run", str(place.folder / "far.toml"), "--out", str(place.out))
    code, _, err = vcmvsp_command(*run, "--listen", f"tcp/0.0.0.0:{place.port}")
    assert code == 2
    assert re.search(r"use tls/0\.0\.0\.0:\d+ --keys DIR .* or add --insecure", err)
    code, _, err = vcmvsp_command("agent", "--vehicle", "car2", "--connect", "tcp/192.0.2.1:7447")
    assert code == 2
    assert "--keys FILE" in err
    assert not place.out.exists()
    keys = place.folder / "keys"
    code, _, err = vcmvsp_command(*run, "--listen", f"tls/127.0.0.1:{place.port}", "--keys", str(keys))
    assert code == 2
    assert f"no machine has a certificate for car2, car3: vcmvsp keys vehicle car2 --keys {keys}" in err
