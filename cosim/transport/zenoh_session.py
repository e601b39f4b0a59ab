"""Opening a session of Eclipse Zenoh, and the diagnosis of failed connections.

The run's end is `cosim.hosts.hub`, the host's `cosim.hosts.host_client`; the keys are in `cosim.transport.key_names`, the
access rules in `cosim.transport.access_control`. Callbacks are always direct (no thread per callback), and only enqueue. Zenoh
does not report why it could not connect: `diagnose` makes a TLS handshake of its own (RFC 8446).
"""

import contextlib
import datetime as dt
import json
import os
import socket
import ssl
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import zenoh

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport import access_control
from vcmvsp.cosim.transport.endpoints import parts

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle

UNIX = "unixsock-stream//proc/self/fd/"
"""Prefix of an endpoint: followed by the file descriptor of an unnamed Unix socket, or of a folder and the name in it."""

COMMON: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": access_control.LEASE_MS}}},
}

PROBE_S = 1.0  # s, for a connection, and for each step of the handshake


@contextlib.contextmanager
def threads(shared: str) -> Iterator[None]:
    """Set how Zenoh's threads share their work; Zenoh reads it when a process opens its first session. Not inherited."""
    if "ZENOH_RUNTIME" in os.environ:
        yield
        return
    os.environ["ZENOH_RUNTIME"] = shared
    try:
        yield
    finally:
        os.environ.pop("ZENOH_RUNTIME", None)


def opened(own: dict[str, Any], secure: dict[str, Any], failure: str) -> zenoh.Session:
    """A session of this configuration. Raises `UsageError` (it cannot be opened; the message begins with ``failure``)."""
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(access_control.merge(COMMON, own, secure))))
    except zenoh.ZError as error:
        where_in_its_sources = " at /"
        raise UsageError(f"{failure}: {str(error).splitlines()[0].partition(where_in_its_sources)[0]}") from error


def client(endpoint: str, secure: dict[str, Any], failure: str, **connect: Any) -> zenoh.Session:
    """A session that dials an endpoint once; further arguments: of Zenoh's ``connect``. Errors as of `opened`."""
    connect |= {"endpoints": [endpoint], "timeout_ms": 0}
    return opened({"mode": "client", "listen": {"endpoints": []}, "connect": connect}, secure, failure)


def closed(session: zenoh.Session) -> None:
    """Close a session; unfinished handshakes may delay this for seconds, but do not make it fail."""
    with contextlib.suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]


def undeclare(*handles: Any) -> None:
    """Undeclare publishers, subscribers and the like; their session may be closed already."""
    for handle in handles:
        with contextlib.suppress(zenoh.ZError):
            handle.undeclare()


def common_names(session: zenoh.Session) -> Iterable[str | None]:
    """Common names of the certificates at the other ends of a session's links."""
    return [link.auth_identifier for link in session.info.links()]


class PeerCertificate(NamedTuple):
    """The certificate that a run presents."""

    names: tuple[str, ...]  # host names and addresses of the hub
    until: dt.datetime


class Refusal(NamedTuple):
    """Reason for which a connection failed; ``final``: a retry will not help."""

    why: str
    final: bool


def diagnose(endpoint: str, bundle: "Bundle | None") -> Refusal | None:
    """Find out by a separate handshake why Zenoh could not connect.

    Args:
        bundle: the certificate that was used; None: plain TCP.

    Returns:
        the reason; None: this handshake succeeded.
    """
    _, host, port = parts(endpoint)
    try:
        with socket.create_connection((host, port), timeout=PROBE_S) as connection:
            return _probe(connection, host) if bundle is None else _probe_tls(connection, host, bundle)
    except socket.gaierror:
        return Refusal(f"the host name '{host}' is unknown", final=False)
    except OSError as error:
        return Refusal(f"no program listens there ({error.strerror or 'timed out'})", final=False)


def run_certificate(endpoint: str, bundle: "Bundle") -> PeerCertificate:
    """The certificate of the run at an endpoint where `diagnose` found nothing wrong."""
    _, host, port = parts(endpoint)
    with (
        socket.create_connection((host, port), timeout=PROBE_S) as connection,
        _context(bundle).wrap_socket(connection, server_hostname=host) as tls,
    ):
        says: dict[str, Any] = tls.getpeercert() or {}
    until = dt.datetime.fromtimestamp(ssl.cert_time_to_seconds(says["notAfter"]), dt.UTC)
    return PeerCertificate(tuple(name for _, name in says["subjectAltName"]), until)


def _context(bundle: "Bundle") -> ssl.SSLContext:
    context = ssl.create_default_context(ssl.Purpose.SERVER_AUTH, cadata=bundle.ca_pem)
    context.load_cert_chain(bundle.path)
    return context


def _probe(connection: socket.socket, host: str) -> Refusal | None:
    """Probe whether the listener requires TLS."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(connection, server_hostname=host).close()
    except OSError:  # includes a failed or timed out handshake
        return None
    return Refusal("that run requires certificates: connect to tls/... and add --keys FILE", final=True)


def _probe_tls(connection: socket.socket, host: str, bundle: "Bundle") -> Refusal | None:
    context = _context(bundle)
    try:
        tls = context.wrap_socket(connection, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return Refusal(_fault_of_hub(error, host, bundle), final=True)
    except TimeoutError:  # a plain listener of Zenoh, or a run that is being flooded
        return Refusal("the listener there does not use TLS; is it a run with --listen tcp/...?", final=False)
    except OSError as error:
        return Refusal(f"the listener there aborted the handshake ({getattr(error, 'reason', None) or error})", final=False)
    with tls:
        try:
            tls.recv(1)  # in TLS 1.3 the hub checks the client's certificate after the handshake, and sends only an alert
        except ssl.SSLError as error:
            return Refusal(_fault_of_ours(error.reason or str(error), bundle), final=True)
        except OSError:
            return None
    return None


def _fault_of_hub(error: ssl.SSLCertVerificationError, host: str, bundle: "Bundle") -> str:
    """Fault of the hub's certificate (codes: OpenSSL, x509_vfy.h)."""
    match error.verify_code:
        case 9:
            return "the run's certificate is not valid yet: is the clock of this machine right?"
        case 10:
            return "the run's certificate has expired; on its machine: vcmvsp keys hub --keys DIR"
        case 18 | 19 | 20 | 21:
            return f"the run's certificate is of another authority than {bundle.path}: use a file made with the run's own keys"
        case 26:
            return "the listener there is not a run: its certificate is that of a host"
        case 62 | 64:
            return f"the run's certificate is not for '{host}'; on its machine: vcmvsp keys hub --name {host} --keys DIR"
    return f"the run's certificate is bad: {error.verify_message}"


def _fault_of_ours(alert: str, bundle: "Bundle") -> str:
    """Fault of this machine's certificate according to the hub's alert (RFC 8446, 6.2)."""
    if "EXPIRED" in alert:
        return f"by the clock of the run's machine, {bundle.path} has expired or is not valid yet"
    if "UNKNOWN_CA" in alert:
        return f"the run does not know the authority of {bundle.path}: use a file made with the run's own keys"
    return f"the run does not accept {bundle.path} ({alert.lower().replace('_', ' ')})"
