"""Where a run may listen and machines may dial: beyond this machine not without certificates, unless the user wants it so."""

import ipaddress
import re
from typing import TYPE_CHECKING, Literal

from vcmvsp.cosim.errors import UsageError

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle, Keys

_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9A-Fa-f:.]+\]|[^\[\]:/?#\s]+):(\d{1,5})")


Side = Literal["run", "host", "observer", "driver", "robot"]


def endpoint_rules(
    endpoint: str, keys: "Keys | Bundle | str | None" = None, *, insecure: bool = False, side: Side = "run"
) -> None:
    """Raise `UsageError` if this endpoint may not be used so: beyond this machine certificates are a must.

    Args:
        endpoint: ``tcp/HOST:PORT`` or ``tls/HOST:PORT``.
        keys: certificates that the user has named, or where they are.
        insecure: the user wants to do without them.
        side: who asks, for the message.
    """
    protocol, host, _ = parts(endpoint)
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


def is_loopback(host: str) -> bool:
    """Whether a host name or address can be reached from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def parts(endpoint: str) -> tuple[str, str, int]:
    """Protocol, host (an IPv6 address without its brackets) and port.

    Raises:
        UsageError: it is no endpoint.
    """
    found = _ENDPOINT.fullmatch(endpoint)
    if not found or int(found[3]) > 65535:
        raise UsageError(f"'{endpoint}': must be tcp/HOST:PORT or tls/HOST:PORT, e.g. tls/192.168.1.10:7447")
    return found[1], found[2].strip("[]"), int(found[3])
