"""Certificate authority of a site: makes, renews and revokes the certificates of machines (``vcmvsp keys``).

The files and the meaning of a certificate are described in `cosim.security.certificates`.
"""

import contextlib
import re
import socket
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import msgspec

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.security import certificates
from vcmvsp.cosim.security.certificates import HUB, INDEX, ROLE, SUFFIX, VEHICLE, Bundle, Entry, Index, Keys, load, load_bundle
from vcmvsp.cosim.util import limits

CA_DAYS, HUB_DAYS, HOST_DAYS = 3650, 365, 90
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")  # 64: the longest common name (RFC 5280, ub-common-name)
_HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")


def init(folder: Path, names: Sequence[str] = (), *, days: int = HUB_DAYS, force: bool = False) -> Keys:
    """Make an authority and the hub's certificate.

    Args:
        folder: a new or empty one; only its owner will be able to read it.
        names: additional host names and addresses of the hub; those that this machine knows are included automatically.
        force: replace an existing authority, which makes all its certificates void.

    Raises:
        UsageError: the folder is not empty, a name is invalid, or the folder cannot be written.
    """
    if (folder / INDEX).exists():
        if not force:
            raise UsageError(f"{folder}: already contains an authority; --force replaces it and voids all its certificates")
    elif folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UsageError(f"{folder}: is not empty; name a new folder")
    _check_days(days)
    _check_host_names(names)
    authority = certificates.new_authority(CA_DAYS)
    with _writing(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        certificates.write(folder / "ca.key", authority.key_pem)
        certificates.write(folder / "ca.pem", authority.certificate_pem)
        _renew_hub(folder, dict.fromkeys(["localhost", "127.0.0.1", "::1", *_own_names(), *names]), days)
        _write_index(folder, Index())
    return load(folder)


def renew_hub(folder: Path, names: Sequence[str] = (), *, days: int = HUB_DAYS) -> Keys:
    """Renew the hub's certificate for its present names, those of this machine, and ``names``.

    Raises:
        UsageError: the folder has no authority, a name is invalid, or the folder cannot be written.
    """
    keys = load(folder)
    _check_days(days)
    _check_host_names(names)
    with _writing(folder):
        _renew_hub(folder, dict.fromkeys([*keys.names, *_own_names(), *names]), days)
    return load(folder)


def issue(
    folder: Path,
    name: str,  # name of the machine in runs
    vehicles: Sequence[str] = (),  # vehicles whose agents it may host
    *,
    days: int = HOST_DAYS,
    out: Path | None = None,  # file, or existing folder, to write to; None: ``<name>.keys`` in ``folder``
    force: bool = False,  # replace an existing one
) -> Bundle:
    """Make the file of a machine: of a host of these vehicles' agents or, without vehicles, of an observer.

    Raises:
        UsageError: the name is taken, reserved or revoked, a name is invalid, or the file cannot be written.
    """
    keys = load(folder)
    for each in (name, *vehicles):
        if not _NAME.fullmatch(each):
            raise UsageError(f"'{each}' is not a valid name: use at most 64 letters, digits, '_' and '-'")
    if name == HUB:
        raise UsageError(f"'{HUB}' is reserved for the run: choose another name")
    _check_days(days)
    entry = Entry(name, "host" if vehicles else "observer", tuple(dict.fromkeys(vehicles)), certificates.now())
    _check_free(keys.index.find(name), entry, force)
    target = out or folder
    if target.is_dir():
        target /= f"{name}{SUFFIX}"
    if target.exists() and not force:
        raise UsageError(f"{target}: already exists; add --force to overwrite it")
    says = [f"{ROLE}{entry.role}", *(f"{VEHICLE}{vehicle}" for vehicle in entry.vehicles)]
    with _writing(target):
        signed = certificates.sign(_authority(folder), name, says, server=False, days=days)
        certificates.write(target, signed.key_pem + signed.certificate_pem + keys.ca_pem)
        bundle = load_bundle(target)
        _write_index(folder, keys.index.put(msgspec.structs.replace(entry, until=bundle.until)))
    return bundle


def revoke(folder: Path, name: str) -> Entry:
    """Revoke the certificate of a name. Raises `UsageError` (the name has no certificate)."""
    keys = load(folder)
    if (entry := keys.index.find(name)) is None:
        names = ", ".join(each.name for each in keys.index.issued) or "nobody"
        raise UsageError(f"{folder}: no certificate for '{name}'; certificates: {names}")
    entry = msgspec.structs.replace(entry, revoked=True)
    with _writing(folder):
        _write_index(folder, keys.index.put(entry))
    return entry


def _check_days(days: int) -> None:
    if not 1 <= days <= CA_DAYS:
        raise UsageError(f"--days {days}: must be from 1 to {CA_DAYS}")


def _check_host_names(names: Iterable[str]) -> None:
    for name in names:
        if not certificates.is_address(name) and not _HOST_NAME.fullmatch(name):
            raise UsageError(f"--name {name}: must be a host name or an IP address, without protocol and port")


def _check_free(had: Entry | None, new: Entry, force: bool) -> None:
    if had is None:
        return
    if had.revoked:
        raise UsageError(
            f"'{new.name}' was revoked, and a new certificate would make the old one valid again: choose another name"
        )
    if (had.role, set(had.vehicles)) != (new.role, set(new.vehicles)):
        purpose = f"is for {', '.join(had.vehicles)}" if had.vehicles else "is an observer's"
        raise UsageError(f"the certificate of '{new.name}' {purpose}: choose another name (for a vehicle with --as)")
    if not force:
        raise UsageError(f"'{new.name}' already has a certificate until {had.until:%Y-%m-%d}; --force issues another")


def _authority(folder: Path) -> certificates.Signed:
    return certificates.Signed(limits.read_text(folder / "ca.key"), limits.read_text(folder / "ca.pem"))


def _renew_hub(folder: Path, names: Iterable[str], days: int) -> None:
    signed = certificates.sign(_authority(folder), HUB, names, server=True, days=days)
    certificates.write(folder / "hub.key", signed.key_pem)
    certificates.write(folder / "hub.pem", signed.certificate_pem)


def _own_names() -> list[str]:
    name = socket.gethostname()
    names = [name] if _HOST_NAME.fullmatch(name) else []
    with contextlib.suppress(OSError):
        names += [str(each[4][0]).partition("%")[0] for each in socket.getaddrinfo(name, None)]
    for family, elsewhere in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):  # RFC 5737, RFC 3849
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((elsewhere, 9))  # a datagram socket sends nothing here, but knows which address it would send from
            names.append(str(probe.getsockname()[0]))
    return names


def _write_index(folder: Path, index: Index) -> None:
    certificates.write(folder / INDEX, msgspec.json.format(msgspec.json.encode(index)).decode() + "\n")


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Turn file errors into `UsageError`."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"{path}: {error}") from error
