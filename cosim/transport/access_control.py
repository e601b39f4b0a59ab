"""Access control of the network: Zenoh configurations with certificates on both ends and access rules.

Each key contains the name of the machine that may use it (`cosim.transport.key_names`); Zenoh compares it with the certificate.
All other keys are denied in both directions. Zenoh denies silently: a query on a denied key ends at once without a reply, and a
put is dropped.
"""

import base64
from collections.abc import Callable, Iterable, Mapping
from typing import IO, TYPE_CHECKING, Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport.key_names import (
    ABOUT,
    HUB_ALIVE,
    JOIN,
    OPEN,
    PAGE_SCENERY,
    PAGE_UPDATE,
    TOPICS,
    about_key,
    greet_key,
    join_key,
)

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle, Keys

MAX_MESSAGE = 16 * 2**20  # bytes of an answer
MAX_JOIN = 64 * 2**10  # bytes of a join request, which any connected machine may send
MAX_ROBOT = 64 * 2**10  # bytes of any message from a robot
LEASE_MS = 1000  # a machine is lost after so long a silence; the silent side's own lease counts
ACCEPT_MS = 3000  # a connection that stays silent during the handshake is closed after so long
OPEN_MS = 2000  # timeout of a connection attempt

LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_MESSAGE}}}}
"""Receive limits of any hub; Zenoh's default is 1 GiB."""

ROBOT_LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_ROBOT}}}}
"""Receive limits of a driver that waits for a robot."""

LOG = "error,zenoh_link_tls=warn,zenoh::net::routing::hat::broker::pubsub=off"
"""Zenoh's log in a hub with certificates: the only place that gives the reason for a refused connection."""

Config = dict[str, Any]
Allow = Callable[[str, str, list[str], str], None]
"""Adds a rule: its name, flow, messages and key."""


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
    by_role = {role: [entry.name for entry in keys.members if entry.role == role] for role in ("host", "observer")}
    return config | {"access_control": _access(by_role["host"], by_role["observer"])}


def driver_security(keys: "Keys", vehicle: str) -> Config:
    """Security part of a driver's configuration: machines without a certificate for its vehicle may only send a greeting."""
    config = merge(_listening(keys), ROBOT_LIMITS)
    rules = _Rules()
    for name, vehicles in [(entry.name, entry.vehicles) for entry in keys.members if entry.role == "host"]:
        allow = rules.of(name)
        _sees_hub(allow)
        allow("greets", "ingress", ["query"], greet_key(name))
        allow("is answered", "egress", ["reply"], greet_key(name))
        if vehicle in vehicles:
            own = f"vcmvsp/robot/{name}/{vehicle}/*"
            allow("listens", "ingress", ["declare_subscriber"], f"{own}/down")
            allow("is driven", "egress", ["put"], f"{own}/down")
            allow("is heard", "egress", ["declare_subscriber"], f"{own}/up")
            allow("tells", "ingress", ["put"], f"{own}/up")
            allow("is alive", "ingress", ["liveliness_token"], f"{own}/alive")
    return config | {"access_control": rules.config()}


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
    from vcmvsp.cosim.security.certificates import (
        HUB,  # here, because loading the library of certificates takes a quarter of a second
    )

    for name in identifiers:
        if name != HUB:
            raise UsageError(f"the listener there is '{name}', not a run")


def _transport(ca_pem: str, own: Mapping[str, str]) -> Config:
    tls: Config = {"root_ca_certificate_base64": _base64(ca_pem), **own}
    tls |= {"enable_mtls": True, "verify_name_on_connect": True, "close_link_on_expiration": True}
    return {"transport": {"link": {"protocols": ["tls"], "tls": tls, "tx": {"lease": LEASE_MS}}}}


def _listening(keys: "Keys") -> Config:
    tls = {"listen_private_key_base64": _base64(keys.key_pem), "listen_certificate_base64": _base64(keys.certificate_pem)}
    config = _transport(keys.ca_pem, tls)
    config["transport"]["unicast"] = {"accept_timeout": ACCEPT_MS}
    return config


class _Rules:
    """Access rules: all else is denied. "ingress" is from a machine, "egress" to it; the hub's own session is exempt."""

    def __init__(self) -> None:
        self._rules: list[Config] = []
        self._policies: list[Config] = []

    def of(self, name: str) -> Allow:
        """The function that adds rules for the machine of this name."""
        own: list[str] = []
        self._policies.append({"subjects": [name], "rules": own})

        def allow(rule: str, flow: str, messages: list[str], key: str) -> None:
            rule = f"{name}/{rule}"  # names have no slash
            self._rules.append({"id": rule, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": [key]})
            own.append(rule)

        return allow

    def config(self) -> Config:
        """The rules in Zenoh's format."""
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
        allow("opens a page", "ingress", ["declare_subscriber"], PAGE_UPDATE)
        allow("sees it", "egress", ["put"], PAGE_UPDATE)
        allow("asks for scenery", "ingress", ["query"], PAGE_SCENERY)
        allow("gets it", "egress", ["reply"], PAGE_SCENERY)
    return rules.config()


def _sees_hub(allow: Allow) -> None:
    allow("watches", "ingress", ["declare_liveliness_subscriber"], HUB_ALIVE)
    allow("sees", "egress", ["liveliness_token"], HUB_ALIVE)


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
