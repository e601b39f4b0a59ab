"""Admission to a run, with real certificates and real sessions, from this and from another machine, with reasons of refusal."""

import contextlib
import datetime as dt
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest
import zenoh

from tests.support import requirements
from tests.support.cosim.run_processes import reserve_port
from tests.support.cosim.secure_hub import QUIET, Hub, bundle, dial, greet, issue_certificates, start, until
from tests.support.paths import ROOT
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.security import authority, certificates
from vcmvsp.cosim.security.certificates import Bundle, Keys
from vcmvsp.cosim.transport import access_control, zenoh_session
from vcmvsp.cosim.transport.access_control import merge

pytestmark = [pytest.mark.processes, pytest.mark.sockets]


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    return issue_certificates(tmp_path_factory.mktemp("network"))


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    """Another authority, with a certificate of an equal name."""
    folder = tmp_path_factory.mktemp("foreign") / "keys"
    authority.init(folder)
    authority.issue(folder, "car2", ["car2"])
    return certificates.load(folder)


@pytest.fixture
def hub(keys: Keys, stack: contextlib.ExitStack) -> Hub:
    return stack.enter_context(Hub(access_control.hub_security(keys)))


def expiring_certificate(folder: Path, name: str, seconds: float, monkeypatch: pytest.MonkeyPatch) -> Bundle:
    """A certificate that ends after ``seconds``."""
    with monkeypatch.context() as patch:
        real = certificates.now
        patch.setattr(certificates, "now", lambda: real() + dt.timedelta(days=-1, seconds=seconds))
        return authority.issue(folder, name, [name], days=1)


def test_a_certificate_admits_and_both_ends_are_authenticated(hub: Hub, keys: Keys) -> None:
    with dial(hub.endpoint, bundle(keys, "car2")) as host:
        access_control.check_hub(link.auth_identifier for link in host.info.links())
        until(lambda: hub.links("car2"))
        assert greet(host, "car2") == [b"welcome"]
    until(lambda: zenoh_session.diagnose(hub.endpoint, bundle(keys, "car2")) is None)


def refused(endpoint: str, machine: Bundle | None) -> str:
    """Reason of a failed connection; it is final: no retry helps."""
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        dial(endpoint, machine)
    return final_refusal(endpoint, machine).why


def final_refusal(endpoint: str, machine: Bundle | None) -> zenoh_session.Refusal:
    """The final refusal; a slow listener gives none, and is dialled again."""
    found: list[zenoh_session.Refusal] = []

    def is_final() -> bool:
        found[:] = [each for each in [zenoh_session.diagnose(endpoint, machine)] if each is not None]
        return bool(found) and found[0].final

    until(is_final)
    return found[0]


def test_a_file_of_another_authority_is_refused(hub: Hub, keys: Keys, foreign: Keys) -> None:
    other = bundle(foreign, "car2")
    assert "another authority than" in refused(hub.endpoint, other)
    half = foreign.folder / "half.keys"  # trusts the run, but is not trusted by it
    half.write_text(other.key_pem + other.certificate_pem + keys.ca_pem)
    crossed = msgspec.structs.replace(other, path=half, ca_pem=keys.ca_pem)
    assert "the run does not" in refused(hub.endpoint, crossed)


def test_an_expired_certificate_is_refused_by_the_clock_of_the_run(
    hub: Hub, keys: Keys, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = expiring_certificate(keys.folder, "old", -5.0, monkeypatch)
    assert "by the clock of the run's machine" in refused(hub.endpoint, old)


def test_no_admission_without_a_certificate(hub: Hub, keys: Keys) -> None:
    assert "requires certificates" in refused(hub.endpoint.replace("tls/", "tcp/"), None)
    rules = access_control.machine_security(bundle(keys, "car2"))
    for part in ("connect_private_key_base64", "connect_certificate_base64", "enable_mtls"):
        del rules["transport"]["link"]["tls"][part]
    dialling = {"mode": "client", "connect": {"endpoints": [hub.endpoint], "timeout_ms": 0}}
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        start(merge(QUIET, dialling, rules))
    assert hub.links("car2") == []


def test_a_run_under_a_name_without_certificate_is_refused(keys: Keys, stack: contextlib.ExitStack) -> None:
    elsewhere = stack.enter_context(Hub(access_control.hub_security(keys), ("tls/127.0.0.2:0",)))
    why = refused(elsewhere.endpoint, bundle(keys, "car2"))
    assert why == "the run's certificate is not for '127.0.0.2'; on its machine: vcmvsp keys hub --name 127.0.0.2 --keys DIR"


def test_a_host_cannot_pose_as_a_run(keys: Keys, stack: contextlib.ExitStack) -> None:
    rules = access_control.hub_security(keys)
    posing = bundle(keys, "car3")
    own = {"listen_private_key_base64": posing.key_pem, "listen_certificate_base64": posing.certificate_pem}
    rules = merge(rules, {"transport": {"link": {"tls": {name: access_control._base64(pem) for name, pem in own.items()}}}})
    impostor = stack.enter_context(Hub(rules))
    assert "not a run: its certificate is that of a host" in refused(impostor.endpoint, bundle(keys, "car2"))
    with pytest.raises(UsageError, match="the listener there is 'car3', not a run"):
        access_control.check_hub(["hub", "car3"])


def test_a_run_with_expired_certificate_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    folder = authority.init(tmp_path / "keys").folder
    machine = authority.issue(folder, "car2", ["car2"])
    with monkeypatch.context() as patch:
        real = certificates.now
        patch.setattr(certificates, "now", lambda: real() - dt.timedelta(days=2))
        authority.renew_hub(folder, days=1)
    late = stack.enter_context(Hub(access_control.hub_security(certificates.load(folder))))
    assert "has expired; on its machine: vcmvsp keys hub" in refused(late.endpoint, machine)


def test_tls_to_a_run_without_is_refused(keys: Keys, stack: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access_control, "OPEN_MS", 300)
    monkeypatch.setattr(zenoh_session, "PROBE_S", 0.3)
    plain = stack.enter_context(Hub({}, ("tcp/127.0.0.1:0",)))
    endpoint = plain.endpoint.replace("tcp/", "tls/")
    with pytest.raises(zenoh.ZError, match="Unable to connect"):
        dial(endpoint, bundle(keys, "car2"))
    silent = "the listener there does not use TLS; is it a run with --listen tcp/...?"
    assert zenoh_session.diagnose(endpoint, bundle(keys, "car2")) == zenoh_session.Refusal(silent, final=False)
    assert zenoh_session.diagnose(plain.endpoint, None) is None


def test_a_missing_listener_is_not_final(keys: Keys, stack: contextlib.ExitStack) -> None:
    port = stack.enter_context(reserve_port())
    for machine, protocol in ((bundle(keys, "car2"), "tls"), (None, "tcp")):
        found = zenoh_session.diagnose(f"{protocol}/127.0.0.1:{port}", machine)
        assert found == zenoh_session.Refusal("no program listens there (Connection refused)", final=False)
        found = zenoh_session.diagnose(f"{protocol}/nobody.invalid:{port}", machine)
        assert found == zenoh_session.Refusal("the host name 'nobody.invalid' is unknown", final=False)


HUB_PROCESS = """
import json, sys, zenoh
from pathlib import Path
from vcmvsp.cosim.security import certificates
from vcmvsp.cosim.transport import key_names, access_control as security
zenoh.init_log_from_env_or(security.LOG)
folder, endpoint = sys.argv[1:]
own = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": {"delay": 0, "multicast": {"enabled": False}}}
own["transport"] = {"shared_memory": {"enabled": False}}
rules = security.hub_security(certificates.load(Path(folder)))
with zenoh.open(zenoh.Config.from_json5(json.dumps(security.merge(own, rules)))) as session:
    door = session.declare_queryable(key_names.JOIN)
    print("up", flush=True)
    for query in door:
        with query:
            query.reply(str(query.key_expr), b"welcome")
"""


@contextlib.contextmanager
def hub_process(*arguments: str, before: tuple[str, ...] = ()) -> Iterator["subprocess.Popen[str]"]:
    environment = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    environment["PYTHONPATH"] = str(ROOT)
    process = subprocess.Popen(
        [*before, sys.executable, "-c", HUB_PROCESS, *arguments], stdout=subprocess.PIPE, text=True, env=environment
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        yield process
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


def test_the_run_logs_refusals_with_reasons(
    keys: Keys, foreign: Keys, monkeypatch: pytest.MonkeyPatch, stack: contextlib.ExitStack
) -> None:
    port = stack.enter_context(reserve_port())
    mixed = msgspec.structs.replace(bundle(foreign, "car2"), ca_pem=keys.ca_pem)
    expired = expiring_certificate(keys.folder, "older", -5.0, monkeypatch)
    with hub_process(str(keys.folder), f"tls/127.0.0.1:{port}") as process:
        for machine, protocol in ((mixed, "tls"), (expired, "tls"), (None, "tcp")):
            with pytest.raises(zenoh.ZError):
                dial(f"{protocol}/127.0.0.1:{port}", machine)
        with dial(f"tls/127.0.0.1:{port}", bundle(keys, "car2")) as host:
            assert greet(host, "car2") == [b"welcome"]
        process.kill()
        output, _ = process.communicate()
    for reason in ("UnknownIssuer", "certificate expired", "corrupt message"):
        assert reason in output


def test_a_link_ends_with_its_certificate(hub: Hub, keys: Keys, monkeypatch: pytest.MonkeyPatch) -> None:
    with contextlib.ExitStack() as session:
        for seconds in (2.0, 6.0, 15.0):  # a busy machine may dial too late
            name = f"ending{seconds:g}"
            ending = expiring_certificate(keys.folder, name, seconds, monkeypatch)
            with contextlib.suppress(zenoh.ZError):
                session.enter_context(dial(hub.endpoint, ending))
                break
        until(lambda: hub.links(name) == [True, False])


# --- another machine ---


@pytest.fixture
def other_machine() -> Iterator[tuple[str, str]]:
    """A network namespace linked to this one, and its address; name and address depend on the process id."""
    space, near, far = (f"vc{os.getpid()}{end}" for end in "snf")
    third, fourth = divmod(os.getpid() % 2**14 * 4, 256)
    there, here = f"10.214.{third}.{fourth + 1}", f"10.214.{third}.{fourth + 2}"
    requirements.program("ip")

    def ip(*arguments: str) -> None:
        subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)

    try:
        ip("netns", "add", space)
    except subprocess.CalledProcessError as error:
        requirements.not_allowed(f"network namespaces: {error.stderr.strip()}")
    try:
        try:
            ip("link", "add", near, "type", "veth", "peer", "name", far, "netns", space)
        except subprocess.CalledProcessError as error:
            requirements.not_allowed(f"links between network namespaces: {error.stderr.strip()}")
        ip("addr", "add", f"{here}/30", "dev", near)
        ip("link", "set", near, "up")
        ip("-n", space, "addr", "add", f"{there}/30", "dev", far)
        ip("-n", space, "link", "set", far, "up")
        yield space, there
    finally:
        subprocess.run(["ip", "link", "del", near], check=False, capture_output=True)
        subprocess.run(["ip", "netns", "del", space], check=False, capture_output=True)


def test_between_machines(other_machine: tuple[str, str], tmp_path: Path, foreign: Keys) -> None:
    space, address = other_machine
    there, endpoint = ("ip", "netns", "exec", space), f"tls/{address}:7447"
    held = authority.init(tmp_path / "keys")
    machine = authority.issue(held.folder, "car2", ["car2"])
    with hub_process(str(held.folder), endpoint, before=there):
        assert f"not for '{address}'; on its machine: vcmvsp keys hub --name {address}" in refused(endpoint, machine)
    authority.renew_hub(held.folder, [address])
    with hub_process(str(held.folder), endpoint, before=there):
        with dial(endpoint, machine) as host:
            assert greet(host, "car2") == [b"welcome"]
            assert greet(host, "car3") == []
        assert "another authority than" in refused(endpoint, bundle(foreign, "car2"))
        assert "requires certificates" in refused(endpoint.replace("tls/", "tcp/"), None)
