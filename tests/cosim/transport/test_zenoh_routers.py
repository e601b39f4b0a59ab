"""A foreign Zenoh router between a run and its hosts, with the page's configuration."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

import vcmvsp
from tests.cosim.hosts.test_remote_hosts import far
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.run_processes import Stage, exit_of, output_at_exit
from tests.support.docs.readme_pages import blocks_of
from tests.support.paths import ROOT
from vcmvsp.cosim.security import certificates
from vcmvsp.cosim.transport import access_control

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

HOSTED = ("car2", "car3")


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    (tmp_path / "far.toml").write_text(far(1.0))
    with Stage(tmp_path) as made:
        yield made


def configuration(run: int, listen: int) -> str:
    """The page's configuration with other ports."""
    page = "cosim/SCALING.md"
    (text,) = (each.text for each in blocks_of(page, (ROOT / page).read_text("utf-8")) if each.language == "json5")
    assert text.count("192.168.1.10:7447") == text.count("0.0.0.0:7448") == 1
    return text.replace("192.168.1.10:7447", f"127.0.0.1:{run}").replace("0.0.0.0:7448", f"127.0.0.1:{listen}")


def test_a_router_between_a_run_and_its_hosts_changes_no_bit(stage: Stage) -> None:
    beyond = stage.another_port()
    with zenoh.open(zenoh.Config.from_json5(configuration(stage.port, beyond))) as router:
        run = stage.start("run", "far.toml", "--listen", stage.endpoint, "--insecure", "--out", "out")
        dialled = f"tcp/127.0.0.1:{beyond}"
        hosts = [stage.start("agent", "--vehicle", name, "--connect", dialled, "--insecure") for name in HOSTED]
        output_at_exit(0, run)
        assert [exit_of(host)[0] for host in hosts] == [0, 0]
        assert not router.is_closed()
    alone = vcmvsp.run(stage.folder / "far.toml", agents="inprocess", mcap=False).metrics["digest"]
    assert stage.digest() == alone


def test_with_certificates_routers_are_refused(stage: Stage) -> None:
    """Not even a router with the run's own certificate for its clients, and the certificate of the hosts for the run."""
    keys = stage.folder / "keys"
    assert vcmvsp_command("keys", "init", str(keys)).code == 0
    assert vcmvsp_command("keys", "vehicle", *HOSTED, "--keys", str(keys), "--as", "both").code == 0
    bundle = certificates.load_bundle(keys / "both.keys")
    run = stage.start("run", "far.toml", "--listen", f"tls/127.0.0.1:{stage.port}", "--keys", "keys", "--out", "out")
    beyond = stage.another_port()
    config = zenoh.Config.from_json5(configuration(stage.port, beyond).replace("tcp/", "tls/"))
    secure = access_control.merge(access_control._listening(certificates.load(keys)), access_control.machine_security(bundle))
    config.insert_json5("transport/link/tls", json.dumps(secure["transport"]["link"]["tls"]))
    with zenoh.open(config):
        host = stage.start("agent", "--vehicle", "car2", "--connect", f"tls/127.0.0.1:{beyond}", "--keys", "keys/both.keys")
        code, output = exit_of(host)
        assert run.poll() is None
    assert code == 2
    assert "'both' is unknown to this run" in output
