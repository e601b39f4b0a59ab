"""Keys and certificates (X.509, RFC 5280) of ECDSA P-256: made, signed, read; their meaning: `cosim.security.certificates`."""

import contextlib
import datetime as dt
import ipaddress
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from vcmvsp.cosim.util.files import write_whole

BACKDATED = dt.timedelta(hours=1)  # clocks of machines differ
_PEM = re.compile(r"-----BEGIN ([A-Z ]+)-----.*?-----END \1-----", re.DOTALL)


class Signed(NamedTuple):
    """A private key and the certificate for it."""

    key_pem: str
    certificate_pem: str


class Facts(NamedTuple):
    """What a certificate says."""

    name: str  # common name
    others: tuple[str, ...]  # host names, addresses and URIs that it is for as well
    since: dt.datetime
    until: dt.datetime


def now() -> dt.datetime:
    """The time in whole seconds, as certificates have it."""
    return dt.datetime.now(dt.UTC).replace(microsecond=0)


def new_authority(days: int) -> Signed:
    """A certificate that signs itself, and may sign others that sign none."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = _subject(f"vcmvsp authority {os.urandom(4).hex()}")
    draft = _draft(subject, subject, key.public_key(), days)
    draft = draft.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    draft = draft.add_extension(_usage(signs_certificates=True), critical=True)
    draft = draft.add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    return Signed(_key_pem(key), _pem(draft.sign(key, hashes.SHA256())))


@contextlib.contextmanager
def _known() -> Iterator[None]:
    """What the library has no name for is damaged, or none of ours: a ``ValueError``, as for all else that is wrong."""
    try:
        yield
    except UnsupportedAlgorithm as error:
        raise ValueError(f"{error}") from error


@_known()
def sign(authority: Signed, name: str, others: Iterable[str], *, server: bool, days: int) -> Signed:
    """A new key, and a certificate for it.

    Args:
        authority: signs it.
        name: common name.
        others: host names, addresses (where it is a server) or URIs (where it is none).
        server: whether it is good for listening, or for dialling.
        days: how long it is valid.

    Raises:
        ValueError: the authority is damaged, or ends before.
    """
    ca = x509.load_pem_x509_certificate(authority.certificate_pem.encode())
    ca_key = serialization.load_pem_private_key(authority.key_pem.encode(), None)
    if not isinstance(ca_key, ec.EllipticCurvePrivateKey) or ca_key.public_key() != ca.public_key():
        raise ValueError("the key of the authority is not that of its certificate")
    if now() + dt.timedelta(days=days) > ca.not_valid_after_utc:
        raise ValueError(f"{days} days are too many: the authority is valid until {ca.not_valid_after_utc:%Y-%m-%d}")
    purpose = ExtendedKeyUsageOID.SERVER_AUTH if server else ExtendedKeyUsageOID.CLIENT_AUTH
    alternatives = [_server_name(each) if server else x509.UniformResourceIdentifier(each) for each in others]
    key = ec.generate_private_key(ec.SECP256R1())
    draft = _draft(_subject(name), ca.subject, key.public_key(), days)
    draft = draft.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    draft = draft.add_extension(_usage(signs_certificates=False), critical=True)
    draft = draft.add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
    draft = draft.add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key())
    return Signed(_key_pem(key), _pem(draft.add_extension(issuer, critical=False).sign(ca_key, hashes.SHA256())))


@_known()
def facts(certificate_pem: str) -> Facts:
    """Read a certificate.

    Raises:
        ValueError: it is none, or not of the kind that `sign` makes.
    """
    certificate = x509.load_pem_x509_certificate(certificate_pem.encode())
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    try:
        others = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName)
    except x509.ExtensionNotFound as error:
        raise ValueError("the certificate says not what it is for") from error
    if len(names) != 1:
        raise ValueError("the certificate has not one common name")
    since, until = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    return Facts(str(names[0].value), tuple(str(each.value) for each in others.value), since, until)


@_known()
def check_together(signed: Signed, ca_pem: str) -> None:
    """Raise ``ValueError`` unless the key is that of the certificate, and the certificate signed by this authority."""
    certificate = x509.load_pem_x509_certificate(signed.certificate_pem.encode())
    key = serialization.load_pem_private_key(signed.key_pem.encode(), None)
    if not isinstance(key, ec.EllipticCurvePrivateKey) or certificate.public_key() != key.public_key():
        raise ValueError("the key is not that of the certificate")
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
    """Write what only the owner may read, at once whole: never half a file in place of a good one."""
    write_whole(path, text, 0o600)


def _server_name(name: str) -> x509.GeneralName:
    return x509.IPAddress(ipaddress.ip_address(name)) if is_address(name) else x509.DNSName(name)


def _subject(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _draft(subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int) -> x509.CertificateBuilder:
    draft = x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key)
    draft = draft.not_valid_before(now() - BACKDATED).not_valid_after(now() + dt.timedelta(days=days))
    return draft.serial_number(x509.random_serial_number())


def _usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _pem(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(serialization.Encoding.PEM).decode()


def _key_pem(key: ec.EllipticCurvePrivateKey) -> str:
    plain = serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain).decode()
