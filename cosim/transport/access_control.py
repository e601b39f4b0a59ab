"""Access control of the network: Zenoh configurations with certificates on both ends and access rules.

Each key contains the name of the machine that may use it (`cosim.transport.key_names`); Zenoh compares it with the certificate.
All other keys are denied in both directions. Zenoh denies silently: a query on a denied key ends at once without a reply, and a
put is dropped.
"""

import base64
from collections.abc import Iterable, Mapping, Sequence
from typing import IO, TYPE_CHECKING, Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport.key_names import ABOUT, HUB_ALIVE, JOIN, OPEN, PAGE_SCENERY, PAGE_UPDATE, TOPICS

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle, Keys

MAX_MESSAGE = 16 * 2**20  # bytes of an answer
MAX_JOIN = 64 * 2**10  # bytes of a join request, which any connected machine may send
MAX_ROBOT = 64 * 2**10  # bytes of any message from a robot
LEASE_MS = 1000  # a machine is lost after so long a silence; the silent side's own lease counts
ACCEPT_MS = 3000  # a connection that stays silent during the handshake is closed after so long
OPEN_MS = 2000  # timeout of a connection attempt

_ACCEPT: dict[str, Any] = {"unicast": {"accept_timeout": ACCEPT_MS}}
LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_MESSAGE}}, **_ACCEPT}}
"""Limits of any hub; Zenoh's defaults are 1 GiB, and 10 s, for which silent connections would also delay the end."""

ROBOT_LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_ROBOT}}, **_ACCEPT}}
"""Receive limits of a driver that waits for a robot."""

LOG = "error,zenoh_link_tls=warn,zenoh::net::routing::hat::broker::pubsub=off"
"""Zenoh's log in a hub with certificates: the only place that gives the reason for a refused connection."""

Config = dict[str, Any]
Rules = Sequence[tuple[str, str, str, str]]
"""Access rules of a machine: name, flow, message and key, in which ``{name}`` is the name of the machine.

All else is denied. "ingress" is from a machine, "egress" to it; the hub's own session is exempt.
"""
_SEES_HUB: Rules = [
    ("watches", "ingress", "declare_liveliness_subscriber", HUB_ALIVE),
    ("sees", "egress", "liveliness_token", HUB_ALIVE),
]
_MACHINE: Rules = [
    ("inquires", "ingress", "query", "vcmvsp/about/{name}"),
    ("is told", "egress", "reply", "vcmvsp/about/{name}"),
    *_SEES_HUB,
]
HOST: Rules = [
    *_MACHINE,
    ("greets", "ingress", "query", "vcmvsp/join/{name}"),
    ("is answered", "egress", "reply", "vcmvsp/join/{name}"),
    ("listens", "ingress", "declare_subscriber", "vcmvsp/host/{name}/*/ask"),
    ("is asked", "egress", "put", "vcmvsp/host/{name}/*/ask"),
    ("is heard", "egress", "declare_subscriber", "vcmvsp/host/{name}/*/answer"),
    ("answers", "ingress", "put", "vcmvsp/host/{name}/*/answer"),
    ("is alive", "ingress", "liveliness_token", "vcmvsp/host/{name}/*/alive"),
]
OBSERVER: Rules = [
    *_MACHINE,
    ("listens", "ingress", "declare_subscriber", TOPICS),
    ("hears", "egress", "put", TOPICS),
    ("opens a page", "ingress", "declare_subscriber", PAGE_UPDATE),
    ("sees it", "egress", "put", PAGE_UPDATE),
    ("asks for scenery", "ingress", "query", PAGE_SCENERY),
    ("gets it", "egress", "reply", PAGE_SCENERY),
]
ROBOT: Rules = [
    *_SEES_HUB,
    ("greets", "ingress", "query", "vcmvsp/robot/{name}/greet"),
    ("is answered", "egress", "reply", "vcmvsp/robot/{name}/greet"),
]


def admission(keys: "Keys", name: str, vehicles: Iterable[str]) -> str | None:
    """Reason to reject a machine of this name as host of these vehicles, or None."""
    entry = keys.index.find(name)
    if entry is None:
        return f"'{name}' has no certificate of this run"
    if entry.revoked:
        return f"the certificate of '{name}' has been revoked"
    if entry.role != "host":
        return f"the certificate of '{name}' is for watching only"
    if foreign := [vehicle for vehicle in vehicles if vehicle not in entry.vehicles]:
        return f"the certificate of '{name}' is for {', '.join(entry.vehicles)}, not for {', '.join(foreign)}"
    return None


def silence(name: str) -> str:
    """The message for a join request that ends without a reply although the connection stands."""
    return f"'{name}' is unknown to this run: its certificate was revoked, or issued after the start of the run"


def hub_security(keys: "Keys") -> Config:
    """Security part of the hub's configuration: certificates on both ends, limits, and an access rule for each machine."""
    config = merge(_listening(keys), LIMITS)
    rule = {"id": "asked", "flows": ["ingress"], "messages": ["query"], "key_exprs": [JOIN, ABOUT], "size_limit": MAX_JOIN}
    config["low_pass_filter"] = [rule]
    hosts = {entry.name: HOST for entry in keys.members if entry.role == "host"}
    observers = {entry.name: OBSERVER for entry in keys.members if entry.role == "observer"}
    return config | {"access_control": access(hosts | observers)}


def driver_security(keys: "Keys", vehicle: str) -> Config:
    """Security part of a driver's configuration: machines without a certificate for its vehicle may only send a greeting."""
    own = f"vcmvsp/robot/{{name}}/{vehicle}/*"
    driven: Rules = [
        *ROBOT,
        ("listens", "ingress", "declare_subscriber", f"{own}/down"),
        ("is driven", "egress", "put", f"{own}/down"),
        ("is heard", "egress", "declare_subscriber", f"{own}/up"),
        ("tells", "ingress", "put", f"{own}/up"),
        ("is alive", "ingress", "liveliness_token", f"{own}/alive"),
    ]
    rules = {entry.name: ROBOT for entry in keys.members if entry.role == "host"}
    rules |= {entry.name: driven for entry in keys.members if vehicle in entry.vehicles}
    return merge(_listening(keys), ROBOT_LIMITS) | {"access_control": access(rules)}


def hub_secret(secret: str, file: IO[bytes]) -> Config:
    """Configuration of a hub that admits machines with its secret; the secret itself does not pass over the link.

    Args:
        file: a file private to this process until the session is open.
    """
    file.write(f"{OPEN}:{secret}\n".encode())
    file.seek(0)
    config = client_secret(secret)
    config["transport"]["auth"]["usrpwd"]["dictionary_file"] = f"/dev/fd/{file.fileno()}"
    return config


def client_secret(secret: str) -> Config:
    """Configuration of a host or an observer with the secret of a run."""
    return {"transport": {"auth": {"usrpwd": {"user": OPEN, "password": secret}}}}


def machine_security(bundle: "Bundle") -> Config:
    """Security part of the configuration of a host, an observer or a robot."""
    tls = {"connect_private_key_base64": _base64(bundle.key_pem), "connect_certificate_base64": _base64(bundle.certificate_pem)}
    config = _transport(bundle.ca_pem, tls)
    config["transport"]["unicast"] = {"open_timeout": OPEN_MS}
    return config


def merge(*configs: Mapping[str, Any]) -> Config:
    """Merge configurations: tables are merged, other values are taken from the later one."""
    merged: Config = {}
    for config in configs:
        for key, value in config.items():
            both = isinstance(value, Mapping) and isinstance(merged.get(key), Mapping)
            merged[key] = merge(merged[key], value) if both else value
    return merged


def check_hub(identifiers: Iterable[str | None]) -> None:
    """Raise `UsageError` unless all links of a session lead to a hub, by the common names of the certificates.

    Zenoh's client trusts all public authorities beside the given one, and anyone can obtain a public certificate for a host
    name; but no public authority issues one with the bare common name ``hub``.
    """
    from vcmvsp.cosim.security.certificates import HUB  # here: the library of certificates takes a quarter of a second

    for name in identifiers:
        if name != HUB:
            raise UsageError(f"the listener there is '{name}', not a run")


def _transport(ca_pem: str, own: Mapping[str, str]) -> Config:
    tls: Config = {"root_ca_certificate_base64": _base64(ca_pem), **own}
    tls |= {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
    return {"transport": {"link": {"protocols": ["tls"], "tls": tls, "tx": {"lease": LEASE_MS}}}}


def _listening(keys: "Keys") -> Config:
    tls = {"listen_private_key_base64": _base64(keys.key_pem), "listen_certificate_base64": _base64(keys.certificate_pem)}
    return _transport(keys.ca_pem, tls)


def access(machines: Mapping[str, Rules]) -> Config:
    """The rules of machines, by name, in Zenoh's format."""
    config: Config = {"enabled": True, "default_permission": "deny", "rules": [], "subjects": [], "policies": []}
    for name, rules in machines.items():
        ids = [f"{name}/{rule}" for rule, *_ in rules]  # names have no slash
        for rule_id, (_, flow, message, key) in zip(ids, rules, strict=True):
            allowed = {"flows": [flow], "messages": [message], "key_exprs": [key.format(name=name)]}
            config["rules"].append({"id": rule_id, "permission": "allow", **allowed})
        config["subjects"].append({"id": name, "cert_common_names": [name]})
        config["policies"].append({"subjects": [name], "rules": ids})
    return config


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
