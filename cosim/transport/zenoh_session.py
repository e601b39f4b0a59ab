"""How a session of Eclipse Zenoh is opened, at whichever end, and why it did not come about.

The run's end is `cosim.hosts.hub`, the host's `cosim.hosts.host_client`; the keys are in `cosim.transport.key_names`, and
who may use which in `cosim.transport.access_control`. Callbacks are always direct (no thread per callback), and only hand over
to a queue. Zenoh does not say why it could not connect: a TLS handshake of our own finds out (RFC 8446).
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
"""Before the file descriptor of a Unix socket that has no name any more, or of a folder, and its name therein."""

COMMON: dict[str, Any] = {
    "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
    "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"lease": access_control.LEASE_MS}}},
}

PROBE_S = 1.0  # for a connection, and for each step of the handshake


@contextlib.contextmanager
def threads(shared: str) -> Iterator[None]:
    """How Zenoh's threads share their work, which it reads when a process opens its first session; not for children of it."""
    if "ZENOH_RUNTIME" in os.environ:
        yield
        return
    os.environ["ZENOH_RUNTIME"] = shared
    try:
        yield
    finally:
        os.environ.pop("ZENOH_RUNTIME", None)


def opened(own: dict[str, Any], secure: dict[str, Any], failure: str) -> zenoh.Session:
    """A session of this configuration. Raises `UsageError` (there can be none; the message begins with ``failure``)."""
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(access_control.merge(COMMON, own, secure))))
    except zenoh.ZError as error:
        where_in_its_sources = " at /"
        raise UsageError(f"{failure}: {str(error).splitlines()[0].partition(where_in_its_sources)[0]}") from error


def closed(session: zenoh.Session) -> None:
    """Close a session; connections that never finish their handshake may hold this up for seconds, and do not make it fail."""
    with contextlib.suppress(zenoh.ZError):
        session.close()  # type: ignore[no-untyped-call]


def common_names(session: zenoh.Session) -> Iterable[str | None]:
    """The names on the certificates at the other ends of a session's links."""
    return [link.auth_identifier for link in session.info.links()]


class PeerCertificate(NamedTuple):
    """The certificate that a run shows."""

    names: tuple[str, ...]  # host names and addresses under which it may be dialled
    until: dt.datetime


class Refusal(NamedTuple):
    """Why a connection did not come about; ``final``: trying again will not help."""

    why: str
    final: bool


def diagnose(endpoint: str, bundle: "Bundle | None") -> Refusal | None:
    """Find out, by a handshake of our own, why Zenoh could not connect, which it does not say.

    Args:
        bundle: the certificate it tried with; None: plain TCP.

    Returns:
        the reason; None: the handshake went well this time.
    """
    _, host, port = parts(endpoint)
    try:
        with socket.create_connection((host, port), timeout=PROBE_S) as connection:
            return _probe(connection, host) if bundle is None else _probe_tls(connection, host, bundle)
    except socket.gaierror:
        return Refusal(f"no machine is known by the name '{host}'", final=False)
    except OSError as error:
        return Refusal(f"nobody listens there ({error.strerror or 'timed out'})", final=False)


def shown(endpoint: str, bundle: "Bundle") -> PeerCertificate:
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
    """Whether what listens there wants TLS, whoever it is."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        context.wrap_socket(connection, server_hostname=host).close()
    except OSError:  # which a failed or timed out handshake is, too
        return None
    return Refusal("that run wants certificates: dial tls/... and add --keys FILE", final=True)


def _probe_tls(connection: socket.socket, host: str, bundle: "Bundle") -> Refusal | None:
    context = _context(bundle)
    try:
        tls = context.wrap_socket(connection, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return Refusal(_fault_of_hub(error, host, bundle), final=True)
    except TimeoutError:  # as a plain listener of Zenoh does, but so does a run that is being flooded
        return Refusal("what listens there does not answer in TLS; is it a run with --listen tcp/...?", final=False)
    except OSError as error:
        return Refusal(f"what listens there broke off the handshake ({getattr(error, 'reason', None) or error})", final=False)
    with tls:
        try:
            tls.recv(1)  # in TLS 1.3 the other end checks our certificate after the handshake, and speaks only if it is bad
        except ssl.SSLError as error:
            return Refusal(_fault_of_ours(error.reason or str(error), bundle), final=True)
        except OSError:
            return None
    return None


def _fault_of_hub(error: ssl.SSLCertVerificationError, host: str, bundle: "Bundle") -> str:
    """What is wrong with the certificate that the hub has shown (codes: OpenSSL, x509_vfy.h)."""
    match error.verify_code:
        case 9:
            return "the run's certificate is not valid yet: is the clock of this machine right?"
        case 10:
            return "the run's certificate has expired; on its machine: vcmvsp keys hub --keys DIR"
        case 18 | 19 | 20 | 21:
            return f"the run's certificate is of another authority than {bundle.path}: use a file made with the run's own keys"
        case 26:
            return "what listens there is no run: its certificate is that of a host"
        case 62 | 64:
            return f"the run's certificate is not for '{host}'; on its machine: vcmvsp keys hub --name {host} --keys DIR"
    return f"the run's certificate is bad: {error.verify_message}"


def _fault_of_ours(alert: str, bundle: "Bundle") -> str:
    """What the hub found wrong with our certificate (alerts: RFC 8446, 6.2)."""
    if "EXPIRED" in alert:
        return f"by the clock of the run's machine, {bundle.path} has expired or is not valid yet"
    if "UNKNOWN_CA" in alert:
        return f"the run does not know the authority of {bundle.path}: use a file made with the run's own keys"
    return f"the run does not accept {bundle.path} ({alert.lower().replace('_', ' ')})"
