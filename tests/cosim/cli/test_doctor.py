"""``vcmvsp doctor --connect``: checks on the way to a run, and the cause of the first failure."""

import contextlib
import datetime as dt
import json
import time
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh.handlers import Callback

from tests.support.cosim.command_line import assert_refused, vcmvsp_command
from tests.support.cosim.run_processes import reserve_port
from tests.support.cosim.secure_hub import lasting_links
from vcmvsp.cosim.hosts import observers, protocol
from vcmvsp.cosim.hosts.event_publisher import ECHO, Topics
from vcmvsp.cosim.hosts.hub import Hub
from vcmvsp.cosim.security import authority, certificates
from vcmvsp.cosim.security.certificates import Keys
from vcmvsp.cosim.transport import access_control, key_names, zenoh_session

pytestmark = pytest.mark.sockets

ABOUT = {"scenario": "here", "duration_s": 60.0, "vehicles": ("car1", "car2"), "missing": lambda: ("car2",)}


@pytest.fixture(autouse=True)
def _links_last(monkeypatch: pytest.MonkeyPatch) -> None:
    lasting_links(monkeypatch)


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Keys:
    folder = tmp_path_factory.mktemp("doctor") / "keys"
    authority.init(folder)
    authority.issue(folder, "laptop", ["car1", "car2"])
    for name in ("anna", "gone"):
        authority.issue(folder, name)
    authority.revoke(folder, "gone")
    return certificates.load(folder)


def opened_hub(stack: contextlib.ExitStack, keys: Keys | None = None) -> Hub:
    hub = Hub("tcp/127.0.0.1:0" if keys is None else "tls/127.0.0.1:0", keys)
    stack.callback(hub.close)
    if keys is None:
        stack.enter_context(pytest.MonkeyPatch.context()).setattr(zenoh_session, "PROBE_S", 0.1)  # it never answers in TLS
    return hub


def shown_hub(stack: contextlib.ExitStack, keys: Keys | None = None) -> str:
    """Endpoint of a hub that publishes what it is."""
    hub = opened_hub(stack, keys)
    stack.callback(Topics(hub.session, ABOUT, keys).close)
    return hub.endpoint


def doctor_checks(endpoint: str, *more: str) -> tuple[int | str | None, dict[str, tuple[bool, str]]]:
    """Exit code; for each check, its result and its text."""
    anybody = ["--insecure"] if endpoint.startswith("tcp/") else []
    code, out, _ = vcmvsp_command("doctor", "--connect", endpoint, *more, *anybody, "--json")
    checks = {each["name"]: (each["ok"], each["words"]) for each in json.loads(out)}
    assert code == (0 if all(ok for ok, _ in checks.values()) else 1)
    return code, checks


def test_all_checks_pass_for_a_host(keys: Keys, stack: contextlib.ExitStack) -> None:
    endpoint = shown_hub(stack, keys)
    code, checks = doctor_checks(endpoint, "--keys", str(keys.folder / "laptop.keys"))
    assert code == 0
    names = ["certificate", "endpoint", "run's certificate", "run", "versions", "round trip", "clocks", "access", "vehicles"]
    assert list(checks) == names
    texts = {name: text for name, (_, text) in checks.items()}
    assert texts["certificate"].startswith("'laptop', host of car1, car2, valid until 20")
    assert "127.0.0.1" in texts["run's certificate"]
    assert f"valid until {keys.until:%Y-%m-%d}" in texts["run's certificate"]
    assert texts["run"] == "here (2 vehicles), not begun yet"
    assert texts["versions"].endswith(f"protocol {protocol.PROTOCOL} at both ends")
    assert texts["access"] == "'laptop' does not receive the topics of the run and acts only for itself"
    assert texts["vehicles"] == "car1, car2; still missing: car2"


def test_all_checks_pass_for_an_observer(keys: Keys, stack: contextlib.ExitStack) -> None:
    endpoint, file = shown_hub(stack, keys), str(keys.folder / "anna.keys")
    code, checks = doctor_checks(endpoint, "--keys", file)
    assert code == 0
    assert checks["access"] == (True, "'anna' receives the topics of the run and acts only for itself")
    code, out, _ = vcmvsp_command("doctor", "--connect", endpoint, "--keys", file)
    assert code == 0
    assert [line[:7] for line in out.splitlines()] == ["ok     "] * 9


def test_missing_certificates_are_reported(stack: contextlib.ExitStack) -> None:
    code, checks = doctor_checks(shown_hub(stack))
    assert code == 0
    assert checks["access"][1].startswith("no certificates are required: anyone in reach of this endpoint receives")


def test_wrong_access_is_found(keys: Keys, stack: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hub without access control: hosts receive its topics and may send on the keys of other vehicles."""
    real = access_control.hub_security

    def lax(known: Keys) -> dict[str, Any]:
        return {name: part for name, part in real(known).items() if name != "access_control"}

    monkeypatch.setattr(access_control, "hub_security", lax)
    code, checks = doctor_checks(shown_hub(stack, keys), "--keys", str(keys.folder / "laptop.keys"))
    assert code == 1
    finding = "'laptop' receives the topics of the run and may act for other vehicles, which is wrong for a host"
    assert checks["access"] == (False, finding)


def test_the_first_failure_is_named_and_ends_the_checks(
    keys: Keys, stack: contextlib.ExitStack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint = shown_hub(stack, keys)
    foreign = tmp_path / "foreign"
    authority.init(foreign)
    authority.issue(foreign, "anna")
    with monkeypatch.context() as patch:
        patch.setattr(certificates, "now", lambda: dt.datetime.now(dt.UTC) - dt.timedelta(days=2))
        authority.issue(foreign, "old", days=1)
    nobody = f"tls/127.0.0.1:{stack.enter_context(reserve_port())}"
    for where, file, name, words in (
        (nobody, keys.folder / "anna.keys", "endpoint", "no program listens there (Connection refused)"),
        (endpoint, foreign / "anna.keys", "endpoint", "is of another authority than"),
        (endpoint, foreign / "old.keys", "certificate", "the certificate of 'old' expired on"),
        (endpoint, keys.folder / "gone.keys", "run", "'gone' is unknown to this run: its certificate was revoked"),
    ):
        code, checks = doctor_checks(where, "--keys", str(file))
        assert code == 1
        assert list(checks)[-1] == name
        assert [ok for ok, _ in checks.values()] == [True] * (len(checks) - 1) + [False]
        assert words in checks[name][1]
    code, checks = doctor_checks(endpoint.replace("tls/", "tcp/"))
    assert checks["endpoint"][1].endswith("that run requires certificates: connect to tls/... and add --keys FILE")


@pytest.mark.parametrize("off_s", [-3600.0, 5.0])
def test_another_clock_and_another_version(stack: contextlib.ExitStack, off_s: float) -> None:
    hub = opened_hub(stack)

    def answer(query: zenoh.Query) -> None:
        about = {"version": "0.0.9", "protocol": 99, "wall_ns": time.time_ns() + int(off_s * 1e9), "you": {"name": "anyone"}}
        with query:
            if query.payload is not None and query.payload.to_bytes() == ECHO:
                hub.session.put(f"{key_names.TOPIC}echo/{key_names.OPEN}", b"")
            query.reply(query.key_expr, json.dumps(about))

    hub.session.declare_queryable(key_names.ABOUT, Callback(answer, indirect=False))
    code, checks = doctor_checks(hub.endpoint)
    assert code == 1
    ok, text = checks["versions"]
    assert not ok
    assert text.endswith("vcmvsp 0.0.9, protocol 99 there: use the same vcmvsp version")
    text = checks["clocks"][1]
    found, spread = float(text.split()[4]), float(text.split()[-2])
    assert ("ahead of" in text) == (off_s > 0)
    assert abs(found - abs(off_s) * 1e3) <= spread + 0.02  # ms; both are rounded


def test_a_run_without_a_description(stack: contextlib.ExitStack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(observers, "PATIENCE_S", 0.5)  # there is no answer to wait for
    code, checks = doctor_checks(opened_hub(stack).endpoint)
    assert code == 1
    assert checks["run"] == (False, "the listener there does not identify its run: use the same vcmvsp version at both ends")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--connect", "nonsense"], "'nonsense': must be tcp/HOST:PORT or tls/HOST:PORT"),
        (["--connect", "tls/127.0.0.1:7447"], "TLS needs certificates: add --keys FILE"),
        (["--connect", "tcp/192.0.2.1:7447"], "plain TCP admits anyone"),
        (["--connect", "tls/127.0.0.1:7447", "--keys", "nobody.keys"], "nobody.keys: cannot be read"),
        (["--keys", "anna.keys"], "--keys and --insecure need a run to connect to: add --connect ENDPOINT"),
        (["--insecure"], "add --connect ENDPOINT"),
        (["--secret", "run.secret"], "--secret needs a run to connect to: add --connect ENDPOINT"),
    ],
)
def test_bad_arguments(arguments: list[str], words: str) -> None:
    assert_refused(vcmvsp_command("doctor", *arguments), words)
