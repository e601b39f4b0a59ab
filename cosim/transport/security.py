"""Who may say what over the network: Zenoh configurations with certificates on both ends and rules of access.

Keys of the protocol, with a machine's name NAME from its certificate and ZID, the id of its Zenoh session::

    vcmvsp/join/NAME             queryable of the hub: a host that wants to take part
    vcmvsp/about/NAME            queryable of the hub: what run this is, and what NAME is to it
    vcmvsp/host/NAME/ZID/ask     the hub publishes questions to a host
    vcmvsp/host/NAME/ZID/answer  the host publishes its answers
    vcmvsp/host/NAME/ZID/alive   liveliness token of a host
    vcmvsp/hub/alive             liveliness token of the hub
    vcmvsp/topic/...             what the run shows to observers

Where a driver of the run waits for the robot of its vehicle, which has a program of its own aboard (`hardware.onboard`)::

    vcmvsp/robot/NAME/greet              queryable of the driver: a robot that wants to be driven
    vcmvsp/robot/NAME/VEHICLE/ZID/down   the driver publishes velocities to a robot
    vcmvsp/robot/NAME/VEHICLE/ZID/up     the robot publishes what it knows of itself
    vcmvsp/robot/NAME/VEHICLE/ZID/alive  liveliness token of a robot

A machine's name stands in each key that it may use, and the hub lets it use no other (Zenoh compares with the certificate). So
the key says for certain who speaks, and what a payload says of it is worth nothing. All else is denied, both ways. Zenoh denies
in silence: a query on a denied key ends at once without a reply, and a put goes nowhere.
"""

import base64
import datetime as dt
import ipaddress
import re
import socket
import ssl
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from cosim.errors import UsageError

if TYPE_CHECKING:
    from cosim.certificates import Bundle, Keys

OPEN = "anyone"
"""The name that stands in the keys of a host without a certificate (on this machine, or where the user wants none)."""

JOIN, ABOUT, HUB_ALIVE = "vcmvsp/join/*", "vcmvsp/about/*", "vcmvsp/hub/alive"
TOPIC, TOPICS = "vcmvsp/topic/", "vcmvsp/topic/**"
GREET = "vcmvsp/robot/*/greet"
ALIVE = "vcmvsp/host/*/*/alive"

MAX_MESSAGE = 16 * 2**20  # bytes of an answer
MAX_JOIN = 64 * 2**10  # bytes of a greeting, which anybody may send who is let in at all
MAX_ROBOT = 64 * 2**10  # bytes of anything that a robot says
LEASE_MS = 1000  # who says nothing for so long is gone; the lease of the silent one counts
ACCEPT_MS = 3000  # who dials and then says nothing holds a place for so long
OPEN_MS = 2000  # who dials something that does not answer tries for so long
PROBE_S = 1.0

LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_MESSAGE}}}}
"""Of any hub; Zenoh's own is 1 GiB."""

ROBOT_LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_ROBOT}}}}
"""The same, where a driver waits for a robot."""

LOG = "error,zenoh_link_tls=warn"
"""What Zenoh is to log in a hub with certificates: why it turned somebody away at the door is said nowhere else."""

_KEY = re.compile(r"vcmvsp/(?:(?:join|about)/([A-Za-z0-9_-]+)|host/([A-Za-z0-9_-]+)/([0-9a-f]{1,32})/(?:ask|alive))")
_ROBOT = re.compile(r"vcmvsp/robot/([A-Za-z0-9_-]+)/(?:greet|([A-Za-z0-9_-]+)/([0-9a-f]{1,32})/(?:up|down|alive))")
_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9A-Fa-f:.]+\]|[^\[\]:/?#\s]+):(\d{1,5})")

Side = Literal["run", "host", "observer", "driver", "robot"]
Config = dict[str, Any]
Allow = Callable[[str, str, list[str], str], None]
"""Takes a rule: what it is called, its flow, messages and key."""


class Shown(NamedTuple):
    """The certificate that a run shows."""

    names: tuple[str, ...]  # host names and addresses under which it may be dialled
    until: dt.datetime


class Refusal(NamedTuple):
    """Why a connection did not come about; ``final``: trying again will not help."""

    why: str
    final: bool


def join_key(name: str) -> str:
    """Where a host greets the hub."""
    return f"vcmvsp/join/{name}"


def about_key(name: str) -> str:
    """Where a machine asks what run this is."""
    return f"vcmvsp/about/{name}"


def answer_key(ask: str) -> str:
    """Where a host answers what it is asked under this key."""
    return f"{ask.removesuffix('ask')}answer"


def host_key(name: str, zid: str, what: Literal["ask", "alive"]) -> str:
    """A key of a host.

    Raises:
        ValueError: the name or the id has characters that could make it another host's key.
    """
    key = f"vcmvsp/host/{name}/{zid}/{what}"
    if speaker(key) is None:
        raise ValueError(f"no key of a host: {key!r}")
    return key


def speaker(key: str) -> tuple[str, str] | None:
    """Name and session id (empty unless it is a host's key) of the machine that a key belongs to.

    None: the key is none, or is for many.
    """
    found = _KEY.fullmatch(key)
    return (found[1] or found[2], found[3] or "") if found else None


def greet_key(name: str) -> str:
    """Where a robot greets the driver that waits for it."""
    return f"vcmvsp/robot/{name}/greet"


def robot_key(name: str, vehicle: str, zid: str, what: Literal["up", "down", "alive"]) -> str:
    """A key of a robot.

    Raises:
        ValueError: one of these has characters that could make it another robot's key.
    """
    key = f"vcmvsp/robot/{name}/{vehicle}/{zid}/{what}"
    if robot_speaker(key) is None:
        raise ValueError(f"no key of a robot: {key!r}")
    return key


def robot_speaker(key: str) -> tuple[str, str, str] | None:
    """Name of the machine, vehicle and session id (empty where it greets) of the robot that a key belongs to.

    None: the key is none, or is for many.
    """
    found = _ROBOT.fullmatch(key)
    return (found[1], found[2] or "", found[3] or "") if found else None


def admission(keys: "Keys", name: str, vehicles: Iterable[str]) -> str | None:
    """Why a machine of this name may not speak for these vehicles; None: it may."""
    entry = keys.index.find(name)
    if entry is None:
        return f"no certificate was given to '{name}'"
    if entry.revoked:
        return f"the certificate of '{name}' has been revoked"
    if entry.role != "host":
        return f"the certificate of '{name}' is for watching only"
    if foreign := [vehicle for vehicle in vehicles if vehicle not in entry.vehicles]:
        return f"the certificate of '{name}' is for {', '.join(entry.vehicles)}, not for {', '.join(foreign)}"
    return None


def silence(name: str) -> str:
    """What to say when the hub ends a greeting without a reply, though the connection stands."""
    return f"the run's rules do not know '{name}': its certificate was revoked, or made after the run had begun to listen"


def hub_security(keys: "Keys") -> Config:
    """What the hub's configuration needs: certificates on both ends, limits, and an access rule for each machine."""
    config = merge(_listening(keys), LIMITS)
    asked = {"id": "asked", "flows": ["ingress"], "messages": ["query"], "key_exprs": [JOIN, ABOUT], "size_limit": MAX_JOIN}
    config["low_pass_filter"] = [asked]
    hosts = [entry.name for entry in keys.members if entry.role == "host"]
    observers = [entry.name for entry in keys.members if entry.role == "observer"]
    config["access_control"] = _access(hosts, observers)
    return config


def driver_security(keys: "Keys", vehicle: str) -> Config:
    """The same where a driver waits for the robot of this vehicle: who has no certificate for it may greet, and no more."""
    config = merge(_listening(keys), ROBOT_LIMITS)
    rules = _Rules()
    for entry in keys.members:
        if entry.role == "host":
            _robot_policy(rules.of(entry.name), entry.name, vehicle if vehicle in entry.vehicles else None)
    return config | {"access_control": rules.config()}


def machine_security(bundle: "Bundle") -> Config:
    """What the configuration of a host, an observer or a robot needs."""
    tls = {
        "connect_private_key_base64": _base64(bundle.key_pem),
        "connect_certificate_base64": _base64(bundle.certificate_pem),
    }
    config = _transport(bundle.ca_pem, tls)
    config["transport"]["unicast"] = {"open_timeout": OPEN_MS}
    return config


def merge(*configs: Mapping[str, Any]) -> Config:
    """One configuration of several; of tables the keys of both, of all else the later."""
    merged: Config = {}
    for config in configs:
        for key, value in config.items():
            both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
            merged[key] = merge(merged[key], value) if both else value
    return merged


def check_hub(identifiers: Iterable[str | None]) -> None:
    """Raise `UsageError` unless all links of a session lead to a hub, by the names of the certificates at their other ends.

    Beside the authority that it is given, Zenoh's client trusts all public ones, and anybody may ask those for a certificate of
    a host name of his own; but none of them gives one with the bare common name ``hub``.
    """
    from cosim.certificates import HUB  # here, because loading the library of certificates takes a quarter of a second

    for name in identifiers:
        if name != HUB:
            raise UsageError(f"what answers there is '{name}', not a run")


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
    protocol, host, _ = _parts(endpoint)
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


def diagnose(endpoint: str, bundle: "Bundle | None") -> Refusal | None:
    """Find out, by a handshake of our own, why Zenoh could not connect, which it does not say.

    Args:
        endpoint: where it could not.
        bundle: the certificate it tried with; None: plain TCP.

    Returns:
        the reason; None: the handshake went well this time.
    """
    _, host, port = _parts(endpoint)
    try:
        with socket.create_connection((host, port), timeout=PROBE_S) as connection:
            return _probe(connection, host) if bundle is None else _probe_tls(connection, host, bundle)
    except socket.gaierror:
        return Refusal(f"no machine is known by the name '{host}'", final=False)
    except OSError as error:
        return Refusal(f"nobody listens there ({error.strerror or 'timed out'})", final=False)


def shown(endpoint: str, bundle: "Bundle") -> Shown:
    """The certificate of the run at an endpoint where `diagnose` found nothing wrong."""
    _, host, port = _parts(endpoint)
    with (
        socket.create_connection((host, port), timeout=PROBE_S) as connection,
        _context(bundle).wrap_socket(connection, server_hostname=host) as tls,
    ):
        says: Any = tls.getpeercert()
    until = dt.datetime.fromtimestamp(ssl.cert_time_to_seconds(says["notAfter"]), dt.UTC)
    return Shown(tuple(name for _, name in says["subjectAltName"]), until)


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


def _transport(ca_pem: str, own: Mapping[str, str]) -> Config:
    """TLS and nothing else, with certificates on both ends."""
    tls: Config = {"root_ca_certificate_base64": _base64(ca_pem), **own}
    tls |= {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
    return {"transport": {"link": {"protocols": ["tls"], "tls": tls, "tx": {"lease": LEASE_MS}}}}


def _listening(keys: "Keys") -> Config:
    """TLS for those who dial in."""
    tls = {"listen_private_key_base64": _base64(keys.key_pem), "listen_certificate_base64": _base64(keys.certificate_pem)}
    config = _transport(keys.ca_pem, tls)
    config["transport"]["unicast"] = {"accept_timeout": ACCEPT_MS}
    return config


class _Rules:
    """Deny all but this; "ingress" is what a machine says, "egress" what it hears. The hub's own session is not asked."""

    def __init__(self) -> None:
        self._rules: list[Config] = []
        self._policies: list[Config] = []

    def of(self, name: str) -> Allow:
        """Takes rules for the machine of this name."""
        own: list[str] = []
        self._policies.append({"subjects": [name], "rules": own})

        def allow(rule: str, flow: str, messages: list[str], key: str) -> None:
            rule = f"{name}/{rule}"  # no name has a slash
            self._rules.append({"id": rule, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key]})
            own.append(rule)

        return allow

    def config(self) -> Config:
        """As Zenoh wants it."""
        subjects = [{"id": name, "cert_common_names": [name]} for each in self._policies for name in each["subjects"]]
        default = {"enabled": True, "default_permission": "deny"}
        return {**default, "rules": self._rules, "subjects": subjects, "policies": self._policies}


def _access(hosts: Iterable[str], observers: Iterable[str]) -> Config:
    rules = _Rules()

    def policy(name: str) -> Allow:
        allow = rules.of(name)
        allow("inquires", "ingress", ["query"], about_key(name))
        allow("is told", "egress", ["reply"], about_key(name))
        _sees_hub(allow)
        return allow

    for name in hosts:
        allow = policy(name)
        allow("greets", "ingress", ["query"], join_key(name))
        allow("is answered", "egress", ["reply"], join_key(name))
        allow("listens", "ingress", ["declare_subscriber"], f"vcmvsp/host/{name}/*/ask")
        allow("is asked", "egress", ["put"], f"vcmvsp/host/{name}/*/ask")
        allow("is heard", "egress", ["declare_subscriber"], f"vcmvsp/host/{name}/*/answer")
        allow("answers", "ingress", ["put"], f"vcmvsp/host/{name}/*/answer")
        allow("is alive", "ingress", ["liveliness_token"], f"vcmvsp/host/{name}/*/alive")
    for name in observers:
        allow = policy(name)
        allow("listens", "ingress", ["declare_subscriber"], TOPICS)
        allow("hears", "egress", ["put"], TOPICS)
    return rules.config()


def _robot_policy(allow: Allow, name: str, vehicle: str | None) -> None:
    """Of a machine that may be a robot, if it is for the vehicle that is waited for."""
    _sees_hub(allow)
    allow("greets", "ingress", ["query"], greet_key(name))
    allow("is answered", "egress", ["reply"], greet_key(name))
    if vehicle is not None:
        own = f"vcmvsp/robot/{name}/{vehicle}/*"
        allow("listens", "ingress", ["declare_subscriber"], f"{own}/down")
        allow("is driven", "egress", ["put"], f"{own}/down")
        allow("is heard", "egress", ["declare_subscriber"], f"{own}/up")
        allow("tells", "ingress", ["put"], f"{own}/up")
        allow("is alive", "ingress", ["liveliness_token"], f"{own}/alive")


def _sees_hub(allow: Allow) -> None:
    allow("watches", "ingress", ["declare_liveliness_subscriber"], HUB_ALIVE)
    allow("sees", "egress", ["liveliness_token"], HUB_ALIVE)


def _parts(endpoint: str) -> tuple[str, str, int]:
    found = _ENDPOINT.fullmatch(endpoint)
    if not found or int(found[3]) > 65535:
        raise UsageError(f"'{endpoint}': must be tcp/HOST:PORT or tls/HOST:PORT, e.g. tls/192.168.1.10:7447")
    return found[1], found[2].strip("[]"), int(found[3])


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
