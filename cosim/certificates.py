"""Certificates of the machines that take part in runs: an authority of one's own, and one file for each machine.

::

    keys/                     stays on the machine that runs scenarios
        ca.pem   ca.key       the authority: whoever has its key can let anybody in
        hub.pem  hub.key      what a run shows to those that dial
        index.json            who was given a certificate, and for which vehicles
        car2.keys             to be copied to the machine of car2: private key, certificate, the authority's certificate

The common name of a certificate is the name that a run knows a machine by. Beside it the certificate says itself whether it is
for a host of agents or for an observer, and for which vehicles. A name means one thing for good: a second certificate of a name
is for the same vehicles, and a revoked name is not given again, because the revoked certificate would be as good as the new.
"""

import contextlib
import datetime as dt
import re
import socket
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

import msgspec

from cosim import signing
from cosim.errors import UsageError

Role = Literal["host", "observer"]
HUB = "hub"
CA_DAYS, HUB_DAYS, HOST_DAYS = 3650, 365, 90
WARN = dt.timedelta(days=7)
INDEX, SUFFIX = "index.json", ".keys"
_OURS, _VEHICLE = "vcmvsp:", "vcmvsp:vehicle:"  # of the URIs in a certificate
_NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")  # 64: the longest common name (RFC 5280, ub-common-name)
_HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")


class Entry(msgspec.Struct, frozen=True):
    """The latest certificate that was given to a name."""

    name: str
    role: Role
    vehicles: tuple[str, ...]
    until: dt.datetime
    revoked: bool = False

    @property
    def state(self) -> str:
        """What has become of it: ``revoked``, or as `state_of`."""
        return "revoked" if self.revoked else state_of(self.until)


class Index(msgspec.Struct, frozen=True):
    """All names that an authority has given a certificate to."""

    issued: tuple[Entry, ...] = ()

    def find(self, name: str) -> Entry | None:
        """The entry of a name."""
        return next((entry for entry in self.issued if entry.name == name), None)

    def put(self, new: Entry) -> "Index":
        """The index with this entry instead of one of the same name."""
        return Index((*(entry for entry in self.issued if entry.name != new.name), new))


class Keys(msgspec.Struct, frozen=True):
    """The folder of an authority as a run needs it: the hub's certificate, and who may come."""

    folder: Path
    ca_pem: str
    certificate_pem: str
    key_pem: str
    names: tuple[str, ...]  # host names and addresses under which the hub may be dialled
    since: dt.datetime
    until: dt.datetime
    index: Index

    @property
    def members(self) -> tuple[Entry, ...]:
        """Whoever has a certificate that is not revoked."""
        return tuple(entry for entry in self.index.issued if not entry.revoked)

    def lacking(self, vehicles: Iterable[str]) -> list[str]:
        """Those of the vehicles for which no machine has a valid certificate."""
        served = {vehicle for entry in self.members if entry.until > signing.now() for vehicle in entry.vehicles}
        return [vehicle for vehicle in vehicles if vehicle not in served]

    def check(self) -> str | None:
        """Raise `UsageError` if the hub's certificate is out of date; a warning if it soon will be."""
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
        """Raise `UsageError` if the certificate is out of date; a warning if it soon will be."""
        named = "" if self.vehicles == (self.name,) else f" --as {self.name}"
        what = f"observer {self.name}" if self.role == "observer" else f"vehicle {' '.join(self.vehicles)}{named}"
        remedy = f"vcmvsp keys {what} --force --keys DIR"
        return _check(f"{self.path}: the certificate of '{self.name}'", self.since, self.until, remedy)

    def speaks_for(self, vehicles: Iterable[str]) -> None:
        """Raise `UsageError` if this certificate is not for all these vehicles."""
        if self.role != "host":
            raise UsageError(f"{self.path}: is for watching only; for a vehicle use what 'vcmvsp keys vehicle NAME' makes")
        if foreign := [vehicle for vehicle in vehicles if vehicle not in self.vehicles]:
            raise UsageError(f"{self.path}: is for {', '.join(self.vehicles)}, not for {', '.join(foreign)}")


def init(folder: Path, names: Sequence[str] = (), *, days: int = HUB_DAYS, force: bool = False) -> Keys:
    """Make an authority and the hub's certificate.

    Args:
        folder: a new or empty one; nobody else will be able to read it.
        names: more host names and addresses under which the hub may be dialled; those that this machine knows of itself come on
            their own.
        days: how long the hub's certificate is valid.
        force: make a new authority although there is one, and so all certificates of the old one void.

    Raises:
        UsageError: the folder holds something, a name is none, or it cannot be written.
    """
    if (folder / INDEX).exists():
        if not force:
            raise UsageError(f"{folder}: holds an authority; --force makes a new one, and all certificates of the old one void")
    elif folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
        raise UsageError(f"{folder}: is not empty; name a new folder")
    _check_days(days)
    _check_host_names(names)
    authority = signing.new_authority(CA_DAYS)
    with _writing(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.chmod(0o700)
        signing.write(folder / "ca.key", authority.key_pem)
        signing.write(folder / "ca.pem", authority.certificate_pem)
        _renew_hub(folder, dict.fromkeys(["localhost", "127.0.0.1", "::1", *_own_names(), *names]), days)
        _write_index(folder, Index())
    return load(folder)


def renew_hub(folder: Path, names: Sequence[str] = (), *, days: int = HUB_DAYS) -> Keys:
    """Make the hub's certificate again, for the names that it has, those of this machine, and these.

    Raises:
        UsageError: the folder is none of an authority, a name is none, or it cannot be written.
    """
    keys = load(folder)
    _check_days(days)
    _check_host_names(names)
    with _writing(folder):
        _renew_hub(folder, dict.fromkeys([*keys.names, *_own_names(), *names]), days)
    return load(folder)


def issue(
    folder: Path,
    name: str,
    vehicles: Sequence[str] = (),
    *,
    days: int = HOST_DAYS,
    out: Path | None = None,
    force: bool = False,
) -> Bundle:
    """Make the file of a machine: of a host of these vehicles' agents or, without vehicles, of an observer.

    Args:
        folder: of the authority.
        name: what runs call the machine.
        vehicles: for which it may speak.
        days: how long the certificate is valid.
        out: file, or existing folder, to write to; None: ``<name>.keys`` in ``folder``.
        force: make it again.

    Raises:
        UsageError: the name is taken, reserved or revoked, something is no name, or it cannot be written.
    """
    keys = load(folder)
    for each in (name, *vehicles):
        if not _NAME.fullmatch(each):
            raise UsageError(f"'{each}' is no name: letters, digits, '_' and '-', at most 64")
    if name == HUB:
        raise UsageError(f"'{HUB}' is the name of the run itself: choose another")
    _check_days(days)
    entry = Entry(name, "host" if vehicles else "observer", tuple(dict.fromkeys(vehicles)), signing.now())
    _check_free(keys.index.find(name), entry, force)
    target = folder / f"{name}{SUFFIX}" if out is None else out / f"{name}{SUFFIX}" if out.is_dir() else out
    if target.exists() and not force:
        raise UsageError(f"{target}: exists; --force writes over it")
    says = [f"{_OURS}{entry.role}", *(f"{_VEHICLE}{vehicle}" for vehicle in entry.vehicles)]
    with _writing(target):
        signed = signing.sign(_authority(folder), name, says, server=False, days=days)
        signing.write(target, signed.key_pem + signed.certificate_pem + keys.ca_pem)
        made = load_bundle(target)
        _write_index(folder, keys.index.put(msgspec.structs.replace(entry, until=made.until)))
    return made


def revoke(folder: Path, name: str) -> Entry:
    """Let this name in no more.

    Raises:
        UsageError: no certificate was given to that name.
    """
    keys = load(folder)
    if (entry := keys.index.find(name)) is None:
        known = ", ".join(each.name for each in keys.index.issued) or "nobody"
        raise UsageError(f"{folder}: has given no certificate to '{name}' (but to: {known})")
    entry = msgspec.structs.replace(entry, revoked=True)
    with _writing(folder):
        _write_index(folder, keys.index.put(entry))
    return entry


def load(folder: Path) -> Keys:
    """Read the folder of an authority.

    Raises:
        UsageError: it is none, or damaged.
    """
    if folder.is_file():
        raise UsageError(f"{folder}: is a file; name the folder that 'vcmvsp keys init' has made")
    if not (folder / INDEX).exists():
        raise UsageError(f"{folder}: holds no authority; make one with: vcmvsp keys init {folder}")
    try:
        index = msgspec.json.decode((folder / INDEX).read_bytes(), type=Index)
        ca, hub, key = ((folder / name).read_text() for name in ("ca.pem", "hub.pem", "hub.key"))
        signing.check_together(signing.Signed(key, hub), ca)
        _, names, since, until = signing.facts(hub)
    except (OSError, ValueError) as error:
        raise UsageError(f"{folder}: cannot be read: {error}") from error
    return Keys(folder, ca, hub, key, names, since, until, index)


def load_bundle(path: Path) -> Bundle:
    """Read the file of a machine.

    Raises:
        UsageError: it is none, or damaged.
    """
    if path.is_dir():
        raise UsageError(f"{path}: is a folder; name the file of this machine, e.g. {path / 'car2.keys'}")
    try:
        key, certificate, ca = signing.blocks(path.read_text())
        signing.check_together(signing.Signed(key, certificate), ca)
        name, says, since, until = signing.facts(certificate)
        role = msgspec.convert("".join(says[:1]).removeprefix(_OURS), Role)
        vehicles = tuple(each.removeprefix(_VEHICLE) for each in says[1:])
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        hint = "use one that 'vcmvsp keys vehicle' or 'vcmvsp keys observer' has made"
        raise UsageError(f"{path}: is no file of a machine, or damaged: {hint}") from error
    return Bundle(path, name, role, vehicles, since, until, ca, certificate, key)


def state_of(until: dt.datetime) -> str:
    """``valid``, ``expires soon`` or ``expired``."""
    left = until - signing.now()
    return "expired" if left < dt.timedelta(0) else "expires soon" if left < WARN else "valid"


def _check(what: str, since: dt.datetime, until: dt.datetime, remedy: str) -> str | None:
    now = signing.now()
    if now > until:
        raise UsageError(f"{what} expired on {until:%Y-%m-%d %H:%M} UTC; make a new one with: {remedy}")
    if now < since:
        raise UsageError(f"{what} is valid only from {since:%Y-%m-%d %H:%M} UTC on: is the clock of this machine right?")
    return f"{what} expires on {until:%Y-%m-%d %H:%M} UTC; make a new one with: {remedy}" if until - now < WARN else None


def _check_days(days: int) -> None:
    if not 1 <= days <= CA_DAYS:
        raise UsageError(f"--days {days}: must be from 1 to {CA_DAYS}")


def _check_host_names(names: Iterable[str]) -> None:
    for name in names:
        if not signing.is_address(name) and not _HOST_NAME.fullmatch(name):
            raise UsageError(f"--name {name}: must be a host name or an IP address, without protocol and port")


def _check_free(had: Entry | None, new: Entry, force: bool) -> None:
    if had is None:
        return
    if had.revoked:
        raise UsageError(
            f"'{new.name}' was revoked, and a new certificate would make the old one good again: choose another name"
        )
    if (had.role, set(had.vehicles)) != (new.role, set(new.vehicles)):
        meant = f"is for {', '.join(had.vehicles)}" if had.vehicles else "is an observer's"
        raise UsageError(f"the certificate of '{new.name}' {meant}: choose another name (for a vehicle with --as)")
    if not force:
        raise UsageError(f"'{new.name}' has a certificate until {had.until:%Y-%m-%d}; --force makes another")


def _authority(folder: Path) -> signing.Signed:
    return signing.Signed((folder / "ca.key").read_text(), (folder / "ca.pem").read_text())


def _renew_hub(folder: Path, names: Iterable[str], days: int) -> None:
    signed = signing.sign(_authority(folder), HUB, names, server=True, days=days)
    signing.write(folder / "hub.key", signed.key_pem)
    signing.write(folder / "hub.pem", signed.certificate_pem)


def _own_names() -> list[str]:
    """Name and addresses of this machine, as far as it knows them itself."""
    name = socket.gethostname()
    found = [name] if _HOST_NAME.fullmatch(name) else []
    with contextlib.suppress(OSError):
        found += [str(each[4][0]).partition("%")[0] for each in socket.getaddrinfo(name, None)]
    for family, elsewhere in ((socket.AF_INET, "192.0.2.1"), (socket.AF_INET6, "2001:db8::1")):  # RFC 5737, RFC 3849
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((elsewhere, 9))  # a datagram socket sends nothing here, but knows which address it would send from
            found.append(str(probe.getsockname()[0]))
    return found


def _write_index(folder: Path, index: Index) -> None:
    signing.write(folder / INDEX, msgspec.json.format(msgspec.json.encode(index)).decode() + "\n")


@contextlib.contextmanager
def _writing(what: Path) -> Iterator[None]:
    """Whatever goes wrong with files in here is the user's to hear of."""
    try:
        yield
    except OSError as error:
        raise UsageError(f"{what}: cannot be written: {error.strerror}") from error
    except ValueError as error:
        raise UsageError(f"{what}: {error}") from error
