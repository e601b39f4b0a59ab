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
They are made in `cosim.security.authority`, and read here.
"""

import datetime as dt
from collections.abc import Iterable
from pathlib import Path
from typing import Literal

import msgspec

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.security import x509
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import read_json

Role = Literal["host", "observer"]
HUB = "hub"
WARN = dt.timedelta(days=7)
INDEX, SUFFIX = "index.json", ".keys"
ROLE, VEHICLE = "vcmvsp:", "vcmvsp:vehicle:"  # how the URIs in a certificate begin


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
        served = {vehicle for entry in self.members if entry.until > x509.now() for vehicle in entry.vehicles}
        return [vehicle for vehicle in vehicles if vehicle not in served]

    def file_of(self, vehicle: str) -> str:
        """Name of the file of a machine that has a valid certificate for this vehicle's agent."""
        names = [entry.name for entry in self.members if entry.until > x509.now() and vehicle in entry.vehicles]
        return f"{names[0] if names else vehicle}{SUFFIX}"

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
        index = read_json(limits.read_bytes(folder / INDEX), Index)
        ca, hub, key = (limits.read_text(folder / name) for name in ("ca.pem", "hub.pem", "hub.key"))
        x509.check_together(x509.Signed(key, hub), ca)
        _, names, since, until = x509.facts(hub)
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
        key, certificate, ca = x509.blocks(limits.read_text(path))
        x509.check_together(x509.Signed(key, certificate), ca)
        name, says, since, until = x509.facts(certificate)
        role = msgspec.convert("".join(says[:1]).removeprefix(ROLE), Role)
        vehicles = tuple(each.removeprefix(VEHICLE) for each in says[1:])
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from error
    except ValueError as error:
        hint = "use one that 'vcmvsp keys vehicle' or 'vcmvsp keys observer' has made"
        raise UsageError(f"{path}: is no file of a machine, or damaged: {hint}") from error
    return Bundle(path, name, role, vehicles, since, until, ca, certificate, key)


def state_of(until: dt.datetime) -> str:
    """``valid``, ``expires soon`` or ``expired``."""
    left = until - x509.now()
    return "expired" if left < dt.timedelta(0) else "expires soon" if left < WARN else "valid"


def _check(what: str, since: dt.datetime, until: dt.datetime, remedy: str) -> str | None:
    now = x509.now()
    if now > until:
        raise UsageError(f"{what} expired on {until:%Y-%m-%d %H:%M} UTC; make a new one with: {remedy}")
    if now < since:
        raise UsageError(f"{what} is valid only from {since:%Y-%m-%d %H:%M} UTC on: is the clock of this machine right?")
    return f"{what} expires on {until:%Y-%m-%d %H:%M} UTC; make a new one with: {remedy}" if until - now < WARN else None
