"""Network addresses: `tcp/host:port` and `tcp://host:port` are equivalent everywhere."""

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vcmvsp.cosim.endpoints import Endpoint, endpoint_of, with_slash
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.hosts import ssh_hosts
from vcmvsp.cosim.runs import api, launch
from vcmvsp.cosim.sockets.messages import parsed
from vcmvsp.cosim.transport.endpoints import endpoint_rules
from vcmvsp.hardware.emulators.arcos.program import HostPort, PtyPort, port_of, udp_of
from vcmvsp.hardware.localisation.port_source import address
from vcmvsp.netsim.bridge.gateways.zenoh import ZenohGateway

BOTH = pytest.mark.parametrize("between", ["/", "://"])
HOSTS = st.sampled_from(["localhost", "10.0.0.1", "a-b.example.org", "::1", "fe80::1", ""])


@given(st.sampled_from(["tcp", "tls", "udp", "socket"]), HOSTS, st.none() | st.integers(0, 65535))
def test_both_spellings_are_equal_and_one_is_written(protocol: str, host: str, port: int | None) -> None:
    endpoint = Endpoint(protocol, host, port)
    assert endpoint_of(str(endpoint)) == endpoint_of(str(endpoint).replace("/", "://", 1)) == endpoint
    assert with_slash(str(endpoint).replace("/", "://", 1)) == str(endpoint)


@pytest.mark.parametrize(
    "text",
    ["", "tcp", "10.0.0.1:80", "/dev/ttyUSB0", "tcp://a:70000", "tcp/a:x", "tcp://a:1/b", "tcp://me@a:1", "tcp/::1:5", "tcp:a"],
)
def test_invalid_addresses(text: str) -> None:
    assert endpoint_of(text) is None


@BOTH
def test_each_option_accepts_both(between: str, tmp_path: Path) -> None:
    assert endpoint_rules(f"tcp{between}127.0.0.1:7447") == "tcp/127.0.0.1:7447"
    with pytest.raises(UsageError, match=r"tcp/10\.0\.0\.1:7447: plain TCP admits anyone .*: use tls/10\.0\.0\.1:7447 "):
        endpoint_rules(f"tcp{between}10.0.0.1:7447")
    assert parsed(f"tcp{between}[::1]:7550") == ("::1", 7550)
    assert parsed(f"unix{between}/run/it") == "/run/it"
    assert port_of(f"tcp{between}:8102") == HostPort("127.0.0.1", 8102)
    assert port_of("./tcp/robot") == PtyPort(Path("tcp/robot"))
    assert udp_of(f"udp{between}127.0.0.1:5000", "--ubisense") == HostPort("127.0.0.1", 5000)
    assert address(f"udp{between}0.0.0.0:5010") == ("0.0.0.0", 5010)
    door = ZenohGateway(listen={"car1": f"tcp{between}127.0.0.1:7461", "car2": "tcp/127.0.0.1:7461"})
    with pytest.raises(ValueError, match=r"tcp/127\.0\.0\.1:7461 is assigned to two vehicles"):
        door.check(["car1", "car2"])


@BOTH
def test_a_port_is_identified_in_either_spelling(between: str) -> None:
    def robot(name: str, port: str) -> dict[str, Any]:
        place = [float(name[3:]), 0.0, 0.0]
        return {"name": name, "kind": "amigobot", "pose": place, "driver": {"kind": "arcos", "port": port}}

    vehicles = [robot("car1", "tcp/robot:8101"), robot("car2", f"tcp{between}robot:8101")]
    with pytest.raises(ScenarioError, match="is also used by car1"):
        api.check({"name": "two", "duration_s": 1.0, "vehicle": vehicles})


@BOTH
def test_hosts_of_a_file_dial_either_spelling(between: str, tmp_path: Path) -> None:
    hosts = tmp_path / "hosts.toml"
    hosts.write_text(f'connect = "tcp{between}127.0.0.1:7450"\n[[host]]\nvehicles = ["car2"]\n')
    listen = f"tcp{between}127.0.0.1:7450"
    (plan,) = launch._plan(hosts, ssh_hosts.read(hosts), listen, None, {"car2": ()}, insecure=False, tell=lambda _: None)
    assert "tcp/127.0.0.1:7450" in plan.script()
