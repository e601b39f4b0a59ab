"""Certificates of the machines that take part in runs: the authority's folder, and one file for each machine.

::

    keys/                     stays on the machine that runs scenarios
        ca.pem   ca.key       the authority: its key can admit any machine
        hub.pem  hub.key      certificate of a run's hub
        index.json            issued names, and their vehicles
        car2.keys             for the machine of car2: private key, certificate, the authority's certificate

The common name of a certificate is the machine's name in runs. URIs in the certificate give its role, host of agents or
observer, and its vehicles. The meaning of a name never changes: a second certificate of a name has the same vehicles, and a
revoked name is not issued again, because the revoked certificate would be as good as the new.
Certificates are made in `cosim.security.authority`, and read here.
"""

import contextlib
import datetime as dt
import ipaddress
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal, NamedTuple

import msgspec
from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_json
from vcmvsp.cosim.util.files import write_whole

BACKDATED = dt.timedelta(hours=1)  # clocks of machines differ
_PEM = re.compile(r"-----BEGIN ([A-Z ]+)-----.*?-----END \1-----", re.DOTALL)

Role = Literal["host", "observer"]
HUB = "hub"
WARN = dt.timedelta(days=7)
INDEX, SUFFIX = "index.json", ".keys"
ROLE, VEHICLE = "vcmvsp:", "vcmvsp:vehicle:"  # prefixes of the URIs in a certificate


class Signed(NamedTuple):
    """A private key and its certificate."""

    key_pem: str
    certificate_pem: str


class Facts(NamedTuple):
    """The content of a certificate."""

    name: str  # common name
    others: tuple[str, ...]  # further host names, addresses and URIs
    since: dt.datetime
    until: dt.datetime


def now() -> dt.datetime:
    """The time in whole seconds, the resolution of certificates."""
    return dt.datetime.now(dt.UTC).replace(microsecond=0)


def new_authority(days: int) -> Signed:
    """A self-signed certificate that may sign machines' certificates, but no authorities."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _subject(f"vcmvsp authority {os.urandom(4).hex()}")
    draft = _draft(subject, subject, key.public_key(), days)
    draft = draft.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    draft = draft.add_extension(_usage(signs_certificates=True), critical=True)
    draft = draft.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    return Signed(_key_pem(key), _pem(draft.sign(key, hashes.SHA256())))


@contextlib.contextmanager
def _as_value_error() -> Iterator[None]:
    """Turn errors that the library does not name into `ValueError`: the certificate is damaged or foreign."""
    try:
        yield
    except UnsupportedAlgorithm as error:
        raise ValueError(f"{error}") from error


@_as_value_error()
def sign(authority: Signed, name: str, others: Iterable[str], *, server: bool, days: int) -> Signed:
    """A new key, and a certificate for it.

    Args:
        others: host names and addresses (of a server) or URIs (of a client).
        server: for listening instead of dialling.

    Raises:
        ValueError: the authority is damaged, or expires earlier.
    """
    ca = x509.load_pem_x509_certificate(authority.certificate_pem.encode())
    ca_key = serialization.load_pem_private_key(authority.key_pem.encode(), None)
    if not isinstance(ca_key, ec.EllipticCurvePrivateKey) or ca_key.public_key() != ca.public_key():
        raise ValueError("the key of the authority does not match its certificate")
    if now() + dt.timedelta(days=days) > ca.not_valid_after_utc:
        raise ValueError(f"{days} days are too many: the authority is valid until {ca.not_valid_after_utc:%Y-%m-%d}")
    purpose = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
    alternatives: list[x509.GeneralName] = []
    for each in others:
        host = x509.IPAddress(ipaddress.ip_address(each)) if is_address(each) else x509.DNSName(each)
        alternatives.append(host if server else x509.UniformResourceIdentifier(each))
    key = ec.generate_private_key(ec.SECP256R1())
    draft = _draft(_subject(name), ca.subject, key.public_key(), days)
    draft = draft.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    draft = draft.add_extension(_usage(signs_certificates=False), critical=True)
    draft = draft.add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    draft = draft.add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key())
    return Signed(_key_pem(key), _pem(draft.add_extension(issuer, critical=False).sign(ca_key, hashes.SHA256())))


@_as_value_error()
def facts(certificate_pem: str) -> Facts:
    """Read a certificate. Raises `ValueError` (not a certificate, or not made by `sign`)."""
    certificate = x509.load_pem_x509_certificate(certificate_pem.encode())
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    try:
        others = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound as error:
        raise ValueError("the certificate has no purpose") from error
    if len(names) != 1:
        raise ValueError("the certificate must have exactly one common name")
    since, until = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    return Facts(str(names[0].value), tuple(str(each.value) for each in others.value), since, until)


@_as_value_error()
def check_together(signed: Signed, ca_pem: str) -> None:
    """Raise ``ValueError`` unless the key belongs to the certificate, and this authority has signed it."""
    certificate = x509.load_pem_x509_certificate(signed.certificate_pem.encode())
    key = serialization.load_pem_private_key(signed.key_pem.encode(), None)
    if not isinstance(key, ec.EllipticCurvePrivateKey) or certificate.public_key() != key.public_key():
        raise ValueError("the key does not match the certificate")
    try:
        certificate.verify_directly_issued_by(x509.load_pem_x509_certificate(ca_pem.encode()))
    except (InvalidSignature, TypeError) as error:
        raise ValueError("the certificate is not signed by the authority") from error


def blocks(text: str) -> list[str]:
    """The PEM blocks in a text, each with a line end."""
    return [match.group() + "\n" for match in _PEM.finditer(text)]


def is_address(name: str) -> bool:
    """Whether this is an IP address."""
    with contextlib.suppress(ValueError):
        ipaddress.ip_address(name)
        return True
    return False


def write(path: Path, text: str) -> None:
    """Write a file that only its owner may read, atomically."""
    write_whole(path, text, 0o600)


def _subject(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _draft(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int) -> x509.CertificateBuilder:
    draft = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    draft = draft.not_valid_before(now() - BACKDATED).not_valid_after(now() + dt.timedelta(days=days))
    return draft.serial_number(x509.random_serial_number())


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    kinds = "content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only", "decipher_only"
    signing = {"key_cert_sign": signs_certificates, "crl_sign": signs_certificates}
    return x509.KeyUsage(digital_signature=not signs_certificates, **signing, **dict.fromkeys(kinds, False))


def _pem(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(serialization.Encoding.PEM).decode()


def _key_pem(key: ec.EllipticCurvePrivateKey) -> str:
    plain = serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain).decode()


class Entry(msgspec.Struct, frozen=True):
    """The latest certificate of a name."""

    name: str
    role: Role
    vehicles: tuple[str, ...]
    until: dt.datetime
    revoked: bool = False

    @property
    def state(self) -> str:
        """State of the certificate: ``revoked``, or as `state_of`."""
        return "revoked" if self.revoked else state_of(self.until)


class Index(msgspec.Struct, frozen=True):
    """Index of all issued names of an authority."""

    issued: tuple[Entry, ...] = ()

    def find(self, name: str) -> Entry | None:
        """The entry of a name."""
        return next((entry for entry in self.issued if entry.name == name), None)

    def put(self, new: Entry) -> "Index":
        """The index with this entry instead of one of the same name."""
        return Index((*(entry for entry in self.issued if entry.name != new.name), new))


class Keys(msgspec.Struct, frozen=True):
    """The folder of an authority as a run needs it: the hub's certificate, and the admitted machines."""

    folder: Path
    ca_pem: str
    certificate_pem: str
    key_pem: str
    names: tuple[str, ...]  # host names and addresses of the hub
    since: dt.datetime
    until: dt.datetime
    index: Index

    @property
    def members(self) -> tuple[Entry, ...]:
        """Entries that are not revoked."""
        return tuple(entry for entry in self.index.issued if not entry.revoked)

    def lacking(self, vehicles: Iterable[str]) -> list[str]:
        """Vehicles for which no machine has a valid certificate."""
        served = {vehicle for entry in self.members if entry.until > now() for vehicle in entry.vehicles}
        return [vehicle for vehicle in vehicles if vehicle not in served]

    def file_of(self, vehicle: str) -> str:
        """Name of the file of a machine that has a valid certificate for this vehicle's agent."""
        names = [entry.name for entry in self.members if entry.until > now() and vehicle in entry.vehicles]
        return f"{names[0] if names else vehicle}{SUFFIX}"

    def check(self) -> str | None:
        """Raise `UsageError` if the hub's certificate has expired; returns a warning if it soon will."""
        remedy = f"vcmvsp keys hub --keys {self.folder}"
        return _check(f"{self.folder}: the hub's certificate", self.since, self.until, remedy)


class Bundle(msgspec.Struct, frozen=True):
    """The file of one machine."""

    path: Path
    name: str
    role: Role
    vehicles: tuple[str, ...]
    since: dt.datetime
    until: dt.datetime
    ca_pem: str
    certificate_pem: str
    key_pem: str

    def check(self) -> str | None:
        """Raise `UsageError` if the certificate has expired; returns a warning if it soon will."""
        option = "" if self.vehicles == (self.name,) else f" --as {self.name}"
        arguments = f"observer {self.name}" if self.role == "observer" else f"vehicle {' '.join(self.vehicles)}{option}"
        remedy = f"vcmvsp keys {arguments} --force --keys DIR"
        return _check(f"{self.path}: the certificate of '{self.name}'", self.since, self.until, remedy)

    def speaks_for(self, vehicles: Iterable[str]) -> None:
        """Raise `UsageError` if this certificate is not for all these vehicles."""
        if self.role != "host":
            raise UsageError(f"{self.path}: is for watching only; for a vehicle, use a file made by 'vcmvsp keys vehicle NAME'")
        if foreign := [vehicle for vehicle in vehicles if vehicle not in self.vehicles]:
            raise UsageError(f"{self.path}: is for {', '.join(self.vehicles)}, not for {', '.join(foreign)}")


def load(folder: Path) -> Keys:
    """Read the folder of an authority. Raises `UsageError` (no authority, or a damaged one)."""
    if folder.is_file():
        raise UsageError(f"{folder}: is a file; name a folder made by 'vcmvsp keys init'")
    if not (folder / INDEX).exists():
        raise UsageError(f"{folder}: contains no authority; make one with: vcmvsp keys init {folder}")
    try:
        index = read_json(limits.read_bytes(folder / INDEX), Index)
        ca, hub, key = (limits.read_text(folder / name) for name in ("ca.pem", "hub.pem", "hub.key"))
        check_together(Signed(key, hub), ca)
        _, names, since, until = facts(hub)
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder}: cannot be read: {error}") from error
    return Keys(folder, ca, hub, key, names, since, until, index)


def load_bundle(path: Path) -> Bundle:
    """Read the file of a machine. Raises `UsageError` (no such file, or a damaged one)."""
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; name the file of this machine, e.g. {path / 'car2.keys'}")
    try:
        key, certificate, ca = blocks(limits.read_text(path))
        check_together(Signed(key, certificate), ca)
        name, says, since, until = facts(certificate)
        role = msgspec.convert("".join(says[:1]).removeprefix(ROLE), Role)
        vehicles = tuple(each.removeprefix(VEHICLE) for each in says[1:])
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        hint = "use a file made by 'vcmvsp keys vehicle' or 'vcmvsp keys observer'"
        raise UsageError(f"{path}: not a key file, or damaged: {hint}") from error
    return Bundle(path, name, role, vehicles, since, until, ca, certificate, key)


def state_of(until: dt.datetime) -> str:
    """State of a certificate by its expiry: ``valid``, ``expires soon`` or ``expired``."""
    remaining = until - now()
    if remaining < dt.timedelta(0):
        return "expired"
    return "expires soon" if remaining < WARN else "valid"


def _check(what: str, since: dt.datetime, until: dt.datetime, remedy: str) -> str | None:
    today = now()
    if today > until:
        raise UsageError(f"{what} expired on {until:%Y-%m-%d %H:%M} UTC; make a new one with: {remedy}")
    if today < since:
        raise UsageError(f"{what} is valid only from {since:%Y-%m-%d %H:%M} UTC on: is the clock of this machine right?")
    return f"{what} expires on {until:%Y-%m-%d %H:%M} UTC; make a new one with: {remedy}" if until - today < WARN else None
