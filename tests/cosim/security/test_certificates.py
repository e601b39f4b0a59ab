"""An authority, and the files of machines: contents, acceptance, and refusals."""

import base64
import contextlib
import datetime as dt
import json
import os
import ssl
from collections.abc import Callable
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.cosim.command_line import vcmvsp_command
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.security import authority, certificates

pytestmark = pytest.mark.sockets

DAY = dt.timedelta(days=1)
P_256 = bytes.fromhex("2a8648ce3d030107")  # the curve's identifier (RFC 5480, 2.1.1.1)


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An authority that no test changes."""
    folder = tmp_path_factory.mktemp("authority") / "keys"
    authority.init(folder, ["10.0.0.5", "lab.example.org"])
    authority.issue(folder, "car2", ["car2"])
    authority.issue(folder, "laptop", ["car3", "car4"])
    authority.issue(folder, "anna")
    return folder


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """An authority that a test may change."""
    return authority.init(tmp_path / "keys").folder


@pytest.fixture
def at(monkeypatch: pytest.MonkeyPatch) -> Callable[[dt.timedelta], None]:
    """Shifts the clock."""
    real = certificates.now

    def turn(by: dt.timedelta) -> None:
        monkeypatch.setattr(certificates, "now", lambda: real() + by)

    return turn


def test_a_key_is_never_written_into_an_existing_file(tmp_path: Path) -> None:
    folder, before = tmp_path / "keys", os.umask(0)
    try:
        authority.init(folder)
        victims = [folder / f".{name}.{os.getpid()}" for name in ("ca.key", "hub.key", "car2.keys")]
        victims += [folder / f".{name}.part" for name in ("ca.key", "hub.key", "car2.keys")]
        for victim in victims:
            victim.touch(mode=0o666)
        opened = [victim.open() for victim in victims]
        for name in ("ca.key", "hub.key"):
            (folder / name).unlink()
            (folder / name).symlink_to(victims[0])
        authority.init(folder, force=True)
        authority.issue(folder, "car2", ["car2"])
    finally:
        os.umask(before)
    for file in opened:
        with file:
            assert file.read() == ""
    assert folder.stat().st_mode & 0o777 == 0o700
    for name in ("ca.key", "hub.key", "car2.keys"):
        assert not (folder / name).is_symlink()
        assert (folder / name).stat().st_mode & 0o777 == 0o600


def tls_handshake(server_files: tuple[Path, Path], client_file: Path, ca: Path, host: str) -> str:
    """A TLS handshake in memory, with certificates on both ends, by OpenSSL; returns the error, or "" if both ends accept."""
    server = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server.verify_mode = ssl.CERT_REQUIRED
    server.load_verify_locations(ca)
    server.load_cert_chain(*server_files)
    client = ssl.create_default_context(cafile=str(ca))
    client.load_cert_chain(client_file)
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [
        client.wrap_bio(to_client, to_server, server_hostname=host),
        server.wrap_bio(to_server, to_client, server_side=True),
    ]
    waiting = list(ends)
    for _ in range(6):
        for end in list(waiting):
            try:
                end.do_handshake()
                waiting.remove(end)
            except ssl.SSLWantReadError:
                pass
            except ssl.SSLError as error:
                return f"{error}"
    return "" if not waiting else "unfinished"


def test_openssl_accepts_both_ends_only_in_their_roles_and_of_one_authority(shared: Path, keys: Path) -> None:
    hub, host, ca = (shared / "hub.pem", shared / "hub.key"), shared / "car2.keys", shared / "ca.pem"
    for name in ("localhost", "127.0.0.1", "::1", "10.0.0.5", "lab.example.org"):
        assert tls_handshake(hub, host, ca, name) == ""
    assert "not valid for '10.0.0.6'" in tls_handshake(hub, host, ca, "10.0.0.6")
    as_client = shared / "hub-as-client.pem"
    as_client.write_text((shared / "hub.key").read_text() + (shared / "hub.pem").read_text())
    assert "certificate purpose" in tls_handshake(hub, as_client, ca, "localhost")
    assert "certificate purpose" in tls_handshake((host, host), host, ca, "localhost")
    assert "certificate verify failed" in tls_handshake((keys / "hub.pem", keys / "hub.key"), host, ca, "localhost")


def test_a_certificate_is_as_documented(shared: Path) -> None:
    loaded = x509.load_pem_x509_certificate((shared / "laptop.keys").read_bytes().partition(b"-----END PRIVATE KEY-----\n")[2])
    key = loaded.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey)
    assert isinstance(key.curve, ec.SECP256R1)
    assert loaded.subject.rfc4514_string() == "CN=laptop"
    extensions = loaded.extensions
    assert not extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert list(extensions.get_extension_for_class(x509.ExtendedKeyUsage).value) == [ExtendedKeyUsageOID.CLIENT_AUTH]
    uris = extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(uri.value) for uri in uris] == ["vcmvsp:host", "vcmvsp:vehicle:car3", "vcmvsp:vehicle:car4"]
    ca = x509.load_pem_x509_certificate((shared / "ca.pem").read_bytes())
    assert ca.extensions.get_extension_for_class(x509.BasicConstraints).value == x509.BasicConstraints(ca=True, path_length=0)
    hub = certificates.load(shared)
    assert {"localhost", "127.0.0.1", "::1", "10.0.0.5", "lab.example.org"} <= set(hub.names)


def test_periods_of_validity(shared: Path, keys: Path) -> None:
    now = certificates.now()
    near = dt.timedelta(minutes=2)
    assert abs(certificates.load(shared).until - now - 365 * DAY) < near
    assert abs(certificates.load_bundle(shared / "car2.keys").until - now - 90 * DAY) < near
    assert abs(authority.issue(keys, "car2", ["car2"], days=3).until - now - 3 * DAY) < near
    ca = x509.load_pem_x509_certificate((shared / "ca.pem").read_bytes())
    assert abs(ca.not_valid_after_utc - now - 3650 * DAY) < near


def test_a_file_has_its_role_and_vehicles(shared: Path) -> None:
    laptop, anna = (certificates.load_bundle(shared / f"{name}.keys") for name in ("laptop", "anna"))
    assert (laptop.name, laptop.role, laptop.vehicles) == ("laptop", "host", ("car3", "car4"))
    assert (anna.name, anna.role, anna.vehicles) == ("anna", "observer", ())
    laptop.speaks_for(["car4", "car3"])
    with pytest.raises(UsageError, match=r"laptop\.keys: is for car3, car4, not for car2$"):
        laptop.speaks_for(["car3", "car2"])
    with pytest.raises(UsageError, match="is for watching only"):
        anna.speaks_for(["car2"])


def test_a_vehicle_is_served_by_a_member_whose_certificate_has_not_expired(
    shared: Path, at: Callable[[dt.timedelta], None]
) -> None:
    held = certificates.load(shared)
    assert [entry.name for entry in held.members] == ["car2", "laptop", "anna"]
    assert held.lacking(["car1", "car2", "car3", "car5"]) == ["car1", "car5"]
    at(91 * DAY)
    assert held.lacking(["car2"]) == ["car2"]


def test_nothing_is_overwritten_without_force(keys: Path, tmp_path: Path) -> None:
    ca = (keys / "ca.pem").read_text()
    with pytest.raises(UsageError, match="already contains an authority; --force"):
        authority.init(keys)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with pytest.raises(UsageError, match="is not empty"):
        authority.init(tmp_path / "other", force=True)
    authority.issue(keys, "car2", ["car2"])
    first = (keys / "car2.keys").read_text()
    with pytest.raises(UsageError, match=r"'car2' already has a certificate until .* --force issues another"):
        authority.issue(keys, "car2", ["car2"], out=tmp_path / "else.keys")
    taken = tmp_path / "taken.keys"
    taken.write_text("precious")
    with pytest.raises(UsageError, match=r"taken\.keys: already exists"):
        authority.issue(keys, "car3", ["car3"], out=taken)
    assert (keys / "car2.keys").read_text() == first
    assert taken.read_text() == "precious"
    assert authority.issue(keys, "car2", ["car2"], force=True).certificate_pem not in first
    assert (keys / "ca.pem").read_text() == ca
    authority.init(keys, force=True)
    assert (keys / "ca.pem").read_text() != ca
    assert certificates.load(keys).index.issued == ()


def test_renewing_the_hub_keeps_other_certificates(keys: Path) -> None:
    authority.issue(keys, "car2", ["car2"])
    again = authority.renew_hub(keys, ["10.0.0.9"])
    assert again.names[-1] == "10.0.0.9"
    assert [entry.name for entry in again.members] == ["car2"]
    assert authority.renew_hub(keys).names == again.names
    assert tls_handshake((keys / "hub.pem", keys / "hub.key"), keys / "car2.keys", keys / "ca.pem", "10.0.0.9") == ""


def test_a_names_meaning_is_permanent(keys: Path) -> None:
    authority.issue(keys, "laptop", ["car3", "car4"])
    with pytest.raises(UsageError, match="is for car3, car4: choose another name"):
        authority.issue(keys, "laptop", ["car3", "car5"], force=True)
    with pytest.raises(UsageError, match="is for car3, car4: choose another name"):
        authority.issue(keys, "laptop", force=True)
    assert authority.issue(keys, "laptop", ["car4", "car3"], force=True).name == "laptop"
    assert authority.revoke(keys, "laptop").revoked
    assert certificates.load(keys).members == ()
    assert certificates.load(keys).lacking(["car3"]) == ["car3"]
    with pytest.raises(UsageError, match="'laptop' was revoked, and a new certificate would make the old one valid again"):
        authority.issue(keys, "laptop", ["car3", "car4"], force=True)
    with pytest.raises(UsageError, match=r"no certificate for 'car9'; certificates: laptop"):
        authority.revoke(keys, "car9")


@pytest.mark.parametrize("name", ["", "a b", "../x", "car*", "a/b", "\u00e4", "x" * 65, "a\n", "@a", "$*"])
def test_names_with_special_characters_are_refused(keys: Path, name: str) -> None:
    before = sorted(path.name for path in keys.iterdir())
    with pytest.raises(UsageError, match="is not a valid name"):
        authority.issue(keys, name)
    with pytest.raises(UsageError, match="is not a valid name"):
        authority.issue(keys, "host", ["car2", name])
    assert sorted(path.name for path in keys.iterdir()) == before


def test_the_hubs_name_is_reserved(keys: Path) -> None:
    with pytest.raises(UsageError, match="'hub' is reserved for the run"):
        authority.issue(keys, "hub", ["hub"])
    for name in ("tls/10.0.0.1:7447", "a b", "-x", "10.0.0.1:7447", "*.example.org"):
        with pytest.raises(UsageError, match="must be a host name or an IP address"):
            authority.renew_hub(keys, [name])
    for days in (0, -1, 3651):
        with pytest.raises(UsageError, match=f"--days {days}: must be from 1 to 3650"):
            authority.issue(keys, "car2", ["car2"], days=days)


def test_no_certificate_outlives_the_authority(keys: Path, at: Callable[[dt.timedelta], None]) -> None:
    at(3600 * DAY)
    authority.issue(keys, "car2", ["car2"], days=49)
    with pytest.raises(UsageError, match="days are too many: the authority is valid until"):
        authority.issue(keys, "car3", ["car3"], days=51)


def test_expiry_is_announced_then_an_error(shared: Path, at: Callable[[dt.timedelta], None]) -> None:
    hub = certificates.load(shared)
    host, anna = (certificates.load_bundle(shared / f"{name}.keys") for name in ("laptop", "anna"))
    assert (hub.check(), host.check(), anna.check()) == (None, None, None)
    at(82 * DAY)
    assert host.check() is None
    at(84 * DAY)
    renew = "vcmvsp keys vehicle car3 car4 --as laptop --force --keys DIR"
    assert f"make a new one with: {renew}" in (host.check() or "")
    assert certificates.load(shared).index.issued[0].state == "expires soon"
    at(91 * DAY)
    with pytest.raises(UsageError, match=rf"certificate of 'laptop' expired on .* UTC; make a new one with: {renew}"):
        host.check()
    with pytest.raises(UsageError, match=r"expired on .*: vcmvsp keys observer anna --force --keys DIR"):
        anna.check()
    assert certificates.load(shared).index.issued[0].state == "expired"
    at(366 * DAY)
    with pytest.raises(UsageError, match=r"hub's certificate expired on .* vcmvsp keys hub --keys"):
        hub.check()


def test_a_wrong_clock_is_named(shared: Path, at: Callable[[dt.timedelta], None]) -> None:
    host = certificates.load_bundle(shared / "car2.keys")
    at(-30 * dt.timedelta(minutes=1))
    assert host.check() is None
    at(-20000 * DAY)  # a robot without a battery for its clock
    with pytest.raises(UsageError, match=r"valid only from .* is the clock of this machine right"):
        host.check()


def test_a_folder_is_no_file_and_a_file_no_folder(shared: Path, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"is a folder; name the file of this machine, e.g. .*/keys/car2\.keys"):
        certificates.load_bundle(shared)
    with pytest.raises(UsageError, match="is a file; name a folder"):
        certificates.load(shared / "car2.keys")
    with pytest.raises(UsageError, match="contains no authority; make one with: vcmvsp keys init"):
        certificates.load(tmp_path)
    with pytest.raises(UsageError, match="No such file"):
        certificates.load_bundle(tmp_path / "none.keys")


def test_parts_that_do_not_belong_together_are_refused(shared: Path, keys: Path, tmp_path: Path) -> None:
    authority.issue(keys, "car2", ["car2"])
    one, other = (certificates.blocks((folder / "car2.keys").read_text()) for folder in (shared, keys))
    for parts in ([other[0], *one[1:]], [*one[:2], other[2]], one[:2], [*one, *one], []):
        mixed = tmp_path / "mixed.keys"
        mixed.write_text("".join(parts))
        with pytest.raises(UsageError, match="not a key file, or damaged"):
            certificates.load_bundle(mixed)
    (keys / "hub.key").write_text((shared / "hub.key").read_text())
    with pytest.raises(UsageError, match="the key does not match the certificate"):
        certificates.load(keys)
    (keys / "ca.key").write_text((shared / "ca.key").read_text())
    with pytest.raises(UsageError):
        authority.issue(keys, "car5", ["car5"])


def test_an_unknown_curve_is_damage(shared: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged.keys"
    for number, block in enumerate(parts := certificates.blocks((shared / "laptop.keys").read_text())):
        head, *lines, tail = block.split("\n")[:-1]
        content = base64.b64decode("".join(lines)).replace(P_256, P_256[:-1] + b"\x41")
        text = "\n".join([head, base64.b64encode(content).decode(), tail, ""])
        damaged.write_text("".join([*parts[:number], text, *parts[number + 1 :]]))
        with pytest.raises(UsageError, match="not a key file, or damaged"):
            certificates.load_bundle(damaged)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 1600), st.integers(1, 80), st.binary(max_size=40))
def test_damage_is_one_error(shared: Path, tmp_path: Path, at_: int, count: int, instead: bytes) -> None:
    whole = (shared / "laptop.keys").read_bytes()
    damaged = tmp_path / "damaged.keys"
    damaged.write_bytes(whole[:at_] + instead + whole[at_ + count :])
    good = certificates.load_bundle(shared / "laptop.keys")
    with contextlib.suppress(UsageError):
        read = certificates.load_bundle(damaged)
        assert (read.name, read.role, read.vehicles) == (good.name, good.role, good.vehicles)


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(0, 600), st.integers(1, 80), st.binary(max_size=40))
def test_a_damaged_index_is_one_error(shared: Path, tmp_path: Path, at_: int, count: int, instead: bytes) -> None:
    for name in ("ca.pem", "hub.pem", "hub.key"):
        (tmp_path / name).write_bytes((shared / name).read_bytes())
    whole = (shared / "index.json").read_bytes()
    (tmp_path / "index.json").write_bytes(whole[:at_] + instead + whole[at_ + count :])
    with contextlib.suppress(UsageError):
        certificates.load(tmp_path)


def test_the_command_line_from_init_to_revoke(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert vcmvsp_command("keys", "init", "--name", "10.0.0.5").code == 0
    outcome = vcmvsp_command("keys", "vehicle", "car2")
    assert outcome.code == 0
    assert "vcmvsp agent --vehicle car2 --connect tls/HOST:PORT --keys car2.keys" in outcome.out
    assert vcmvsp_command("keys", "vehicle", "car3", "car4", "--as", "laptop", "--days", "5").code == 0
    (tmp_path / "stick").mkdir()
    assert vcmvsp_command("keys", "observer", "anna", "--out", "stick").code == 0
    assert (tmp_path / "stick" / "anna.keys").exists()
    assert vcmvsp_command("keys", "revoke", "car2").code == 0
    listed = vcmvsp_command("keys", "list", "--json")
    rows = {row["name"]: (row["role"], row["for"], row["state"]) for row in json.loads(listed.out)}
    assert "10.0.0.5" in rows.pop("hub")[1]
    assert rows == {
        "car2": ("host", "car2", "revoked"),
        "laptop": ("host", "car3, car4", "expires soon"),
        "anna": ("observer", "", "valid"),
    }
    lines = vcmvsp_command("keys", "list").out.splitlines()
    assert [line.split()[0] for line in lines] == ["hub", "laptop", "anna", "car2"]
    assert vcmvsp_command("keys", "hub", "--name", "10.0.0.6").code == 0


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["init", "keys"], "already contains an authority"),
        (["init", "new", "--name", "http://x"], "must be a host name or an IP address"),
        (["vehicle", "a", "b"], "need a name for their machine: add --as HOST"),
        (["vehicle", "a/b"], "is not a valid name"),
        (["vehicle", "car2", "--out", "nowhere/car2.keys"], "No such file or directory"),
        (["vehicle", "car2", "--keys", "nowhere"], "make one with: vcmvsp keys init nowhere"),
        (["observer", "hub"], "is reserved for the run"),
        (["revoke", "car9"], "no certificate for 'car9'"),
        (["hub", "--days", "0"], "must be from 1 to 3650"),
    ],
)
def test_wrong_commands_are_one_line_and_change_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], says: str
) -> None:
    monkeypatch.chdir(tmp_path)
    authority.init(Path("keys"))
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    outcome = vcmvsp_command("keys", *arguments)
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (2, "", 1)
    assert says in outcome.err
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
