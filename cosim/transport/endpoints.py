"""Where a run may listen and machines may dial: beyond this machine not without certificates, unless the user wants it so."""

import ipaddress
import socket
from typing import TYPE_CHECKING, Literal

from vcmvsp.cosim.endpoints import Endpoint, endpoint_of
from vcmvsp.cosim.errors import UsageError

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle, Keys

Side = Literal["run", "host", "observer", "driver", "robot"]


def endpoint_rules(
    endpoint: str, keys: "Keys | Bundle | str | None" = None, *, insecure: bool = False, side: Side = "run"
) -> str:
    """The endpoint as Zenoh writes it, if it may be used so: beyond this machine certificates are a must.

    Args:
        endpoint: ``tcp/HOST:PORT`` or ``tls/HOST:PORT``, or the same with ``://``.
        keys: certificates that the user has named, or where they are.
        insecure: the user wants to do without them.
        side: who asks, for the message.

    Raises:
        UsageError: it may not, or is no endpoint.
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
        raise UsageError(f"{endpoint}: Zenoh dials no IPv6 address with TLS: use a host name (vcmvsp keys hub --name adds it)")
    if protocol == "tcp" and keys is not None:
        raise UsageError(f"{endpoint}: plain TCP uses no certificates: write {tls}, or leave out {without}")
    if protocol == "tcp" and not insecure and not is_loopback(host):
        problem = "plain TCP lets in everybody who can reach that address"
        raise UsageError(f"{endpoint}: {problem}: use {tls} {how} ({command}), or add {anyway} where you trust everybody")
    return endpoint


def is_loopback(host: str) -> bool:
    """Whether a host name or address can be reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_interfaces(host: str, *, insecure: bool) -> None:
    """Refuse to hear datagrams on all interfaces, with a `ValueError`, unless the user has said so: anybody may send."""
    try:
        numeric = socket.getaddrinfo(host, None, type=socket.SOCK_DGRAM, flags=socket.AI_NUMERICHOST)[0][4][0]
    except OSError:  # a name
        return
    if not insecure and ipaddress.ip_address(str(numeric).partition("%")[0]).is_unspecified:
        problem = f"{host} lets in everybody who can reach any address of this machine"
        raise ValueError(f"{problem}: listen at the address of one interface, or add insecure = true where you trust everybody")


def parts(endpoint: str) -> tuple[str, str, int]:
    """Protocol, host (an IPv6 address without its brackets) and port.

    Raises:
        UsageError: it is no endpoint.
    """
    found = endpoint_of(endpoint)
    if not found or found.protocol not in ("tcp", "tls") or not found.host or found.port is None:
        raise UsageError(f"'{endpoint}': must be tcp/HOST:PORT or tls/HOST:PORT, e.g. tls/192.168.1.10:7447")
    return found.protocol, found.host, found.port
