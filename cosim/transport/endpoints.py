"""Rules for endpoints: beyond this machine certificates are required, unless the user opts out; secrets of local runs.

The secret of a run without certificates lies in a file that only its user can read: ``PORT.secret`` in
``$XDG_RUNTIME_DIR/vcmvsp``, or in ``vcmvsp-UID`` of the folder for temporary files. Zenoh compares secrets by a challenge: none
passes over the link.
"""

import contextlib
import ipaddress
import os
import socket
import stat
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vcmvsp.cosim.endpoints import Endpoint, endpoint_of
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.files import write_whole

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle, Keys

Side = Literal["run", "host", "observer", "driver", "robot"]

LONGEST = 200  # characters of a secret


def endpoint_rules(
    endpoint: str, keys: "Keys | Bundle | str | None" = None, *, insecure: bool = False, side: Side = "run"
) -> str:
    """Validate an endpoint and return it in Zenoh's form: beyond this machine certificates are required.

    Args:
        endpoint: ``tcp/HOST:PORT`` or ``tls/HOST:PORT``, or the same with ``://``.
        insecure: the user opts out of certificates.

    Raises:
        UsageError: the endpoint is invalid, or not allowed.
    """
    protocol, host, port = parts(endpoint)
    endpoint = str(Endpoint(protocol, host, port))
    how, command = {
        "run": ("--keys DIR", "make it with: vcmvsp keys init DIR"),
        "host": ("--keys FILE", "made on the run's machine with: vcmvsp keys vehicle NAME --keys DIR"),
        "observer": ("--keys FILE", "made on the run's machine with: vcmvsp keys observer NAME --keys DIR"),
        "driver": ('keys = "DIR"', "make it with: vcmvsp keys init DIR"),
        "robot": ("--keys FILE", "made on the run's machine with: vcmvsp keys vehicle NAME --keys DIR"),
    }[side]
    listens = side in ("run", "driver")
    without, anyway = ("keys", "insecure = true") if side == "driver" else ("--keys", "--insecure")
    tls = endpoint.replace("tcp/", "tls/", 1)
    if protocol == "tls" and keys is None:
        raise UsageError(f"{endpoint}: TLS needs certificates: add {how} ({command})")
    if protocol == "tls" and not listens and ":" in host:
        raise UsageError(f"{endpoint}: Zenoh has no TLS for IPv6 addresses: use a host name (vcmvsp keys hub --name adds it)")
    if protocol == "tcp" and keys is not None:
        raise UsageError(f"{endpoint}: plain TCP uses no certificates: write {tls}, or leave out {without}")
    if protocol == "tcp" and not insecure and not is_loopback(host):
        problem = "plain TCP admits anyone who can reach that address"
        raise UsageError(f"{endpoint}: {problem}: use {tls} {how} ({command}), or add {anyway} in a trusted network")
    return endpoint


def is_loopback(host: str) -> bool:
    """Whether a host name or address can be reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_interfaces(host: str, *, insecure: bool) -> None:
    """Raise `ValueError` for datagrams on all interfaces, which any machine may send, unless ``insecure``."""
    try:
        numeric = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)[0][4][0]
    except OSError:  # a host name
        return
    if not insecure and ipaddress.ip_address(str(numeric).partition("%")[0]).is_unspecified:
        problem = f"{host} admits anyone who can reach any address of this machine"
        raise ValueError(f"{problem}: listen at the address of one interface, or add insecure = true in a trusted network")


def parts(endpoint: str) -> tuple[str, str, int]:
    """Protocol, host (an IPv6 address without its brackets) and port. Raises `UsageError` (invalid endpoint)."""
    address = endpoint_of(endpoint)
    if not address or address.protocol not in ("tcp", "tls") or not address.host or address.port is None:
        raise UsageError(f"'{endpoint}': must be tcp/HOST:PORT or tls/HOST:PORT, e.g. tls/192.168.1.10:7447")
    return address.protocol, address.host, address.port


@contextlib.contextmanager
def published(endpoint: str, secret: str) -> Iterator[None]:
    """Publish the secret of a run to programs of its user while it listens at an endpoint.

    Raises:
        UsageError: the folder belongs to another user, or cannot be written to.
    """
    path = _path(endpoint)
    try:
        write_whole(path, secret, 0o600)
    except OSError as error:
        raise UsageError(f"{path}: cannot be written: {error.strerror}; set XDG_RUNTIME_DIR to your own folder") from error
    try:
        yield
    finally:
        if find_secret(endpoint) == secret:  # else another run listens there now
            path.unlink(missing_ok=True)


def find_secret(endpoint: str) -> str | None:
    """The secret of this user's run at an endpoint; None: there is none."""
    with contextlib.suppress(OSError, UnicodeDecodeError):
        return read_secret(_path(endpoint))
    return None


def secret_from(path: Path | None, *, insecure: bool) -> str | None:
    """The secret with which a program dials: from the user's file, none (empty), or as `find_secret` finds it (None).

    Raises:
        UsageError: the file cannot be read.
    """
    if path is None:
        return "" if insecure else None
    try:
        return read_secret(path)
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"--secret {path}: cannot be read ({error})") from error


def read_secret(path: Path) -> str:
    """The secret in a file."""
    with path.open("r") as file:
        return file.read(LONGEST).strip()


def _path(endpoint: str) -> Path:
    own = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(own) / "vcmvsp" if own else Path(tempfile.gettempdir()) / f"vcmvsp-{os.getuid()}"
    with contextlib.suppress(FileExistsError):
        folder.mkdir(0o700)
    about = folder.lstat()
    if about.st_uid != os.getuid() or not stat.S_ISDIR(about.st_mode) or about.st_mode & 0o077:
        raise UsageError(f"{folder}: must be accessible to you only (chmod 700); or set XDG_RUNTIME_DIR to another folder")
    return folder / f"{parts(endpoint)[2]}.secret"
