"""A run without certificates is for programs of one user: other users can neither connect nor answer for a host."""

import stat
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

import vcmvsp
from tests.support.cosim.run_processes import Stage, exit_of, output_at_exit, read_until, wait_for
from tests.support.cosim.teams import ELSEWHERE, LEADER, team
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.hosts import protocol
from vcmvsp.cosim.hosts.host_client import dial, dialling
from vcmvsp.cosim.transport import access_control, endpoints
from vcmvsp.cosim.transport.zenoh_session import client

pytestmark = [pytest.mark.processes, pytest.mark.sockets]


class Place(Stage):
    """A run that listens without certificates, its host, and sessions that dial it."""

    def run(self, *more: str, duration: float = 1.0) -> "subprocess.Popen[str]":
        scenario = team("near", LEADER + ELSEWHERE, duration_s=duration, join_timeout_s=60.0, deadline_s=30.0)
        (self.folder / "near.toml").write_text(scenario)
        return self.start("run", "near.toml", "--listen", self.endpoint, "--out", "out", *more)

    def host(self, *more: str) -> "subprocess.Popen[str]":
        return self.start("agent", "--vehicle", "car1", "--connect", self.endpoint, *more)

    def session(self, secret: str | None) -> zenoh.Session:
        return client(self.endpoint, access_control.client_secret(secret) if secret else {}, "no")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    (tmp_path / "runtime").mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "runtime"))
    with Place(tmp_path) as made:
        yield made


def test_only_the_secret_admits_to_a_run_and_its_user_needs_no_option(place: Place) -> None:
    place.run("--realtime", duration=600.0)
    place.host()
    wait_for(place.out / "run.mcap")
    for secret in (None, "guessed"):
        with pytest.raises(UsageError):
            place.session(secret)
    place.session(endpoints.find_secret(place.endpoint)).close()  # type: ignore[no-untyped-call]
    assert dialling(place.endpoint, None, None) is not None


def test_a_host_does_not_join_a_run_without_a_secret(place: Place, tmp_path: Path) -> None:
    """Without a run of its own user at this address, a host waits and reports it; with --insecure it joins any run."""
    run = place.run("--insecure")
    waiting = place.host()
    assert waiting.stderr is not None
    next(line for line in waiting.stderr if "no run of this user" in line)
    waiting.kill()
    assert exit_of(place.host("--insecure"))[0] == 0
    output = output_at_exit(0, run)
    assert "caution: anyone who can reach" in output


def test_the_file_is_private_and_removed_with_the_run(place: Place, tmp_path: Path) -> None:
    with endpoints.published(place.endpoint, "s3cret"):
        (file,) = (tmp_path / "runtime" / "vcmvsp").iterdir()
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        assert stat.S_IMODE(file.parent.stat().st_mode) == 0o700
        assert endpoints.find_secret(place.endpoint) == "s3cret"
    assert not file.exists()
    file.parent.chmod(0o755)
    with pytest.raises(UsageError, match="chmod 700"), endpoints.published(place.endpoint, "s3cret"):
        pass


def test_an_answer_of_another_session_is_dropped_counted_and_named(place: Place) -> None:
    """Even if it has the secret; the run's bytes do not change."""
    run = place.run("--realtime", duration=2.0)
    read_until(run, "vcmvsp agent")
    with dial(place.endpoint, None, print) as session:

        def asked(sample: zenoh.Sample) -> None:
            answer = str(sample.key_expr).removesuffix("ask") + "answer"
            (number, _), body = protocol.numbers.unpack_from(sample.payload.to_bytes()), protocol.encode(protocol.Stepped([]))
            session.put(answer, b"x" * protocol.SEAL + protocol.number.pack(number) + body)

        session.declare_subscriber("vcmvsp/host/*/*/ask", asked)
        host = place.host()
        output = output_at_exit(0, run)
    assert exit_of(host)[0] == 0
    assert "another session answers in place of the host of car1" in output
    assert place.written("about.json")["forged_answers"]["car1"] > 0
    assert place.digest() == vcmvsp.run(place.folder / "near.toml", agents="inprocess", mcap=False).metrics["digest"]


def test_a_seal_fits_only_its_key_and_answer() -> None:
    sealed = protocol.sealed(b"k" * protocol.SEAL, b"answer")
    assert protocol.is_sealed(b"k" * protocol.SEAL, sealed)
    assert not protocol.is_sealed(b"l" * protocol.SEAL, sealed)
    assert not any(protocol.is_sealed(b"k" * protocol.SEAL, sealed[:n]) for n in range(len(sealed)))
