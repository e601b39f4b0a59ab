"""Who may say what over the network: Zenoh configurations with certificates on both ends and rules of access.

A machine's name stands in each key that it may use (`cosim.transport.key_names`), and the hub lets it use no other: Zenoh
compares with the certificate. All else is denied, both ways. Zenoh denies in silence: a query on a denied key ends at once
without a reply, and a put goes nowhere.
"""

import base64
from collections.abc import Callable, Iterable, Mapping
from typing import IO, TYPE_CHECKING, Any

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport.key_names import ABOUT, HUB_ALIVE, JOIN, OPEN, TOPICS, about_key, greet_key, join_key

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle, Keys

MAX_MESSAGE = 16 * 2**20  # bytes of an answer
MAX_JOIN = 64 * 2**10  # bytes of a greeting, which anybody may send who is let in at all
MAX_ROBOT = 64 * 2**10  # bytes of anything that a robot says
LEASE_MS = 1000  # who says nothing for so long is gone; the lease of the silent one counts
ACCEPT_MS = 3000  # who dials and then says nothing holds a place for so long
OPEN_MS = 2000  # who dials something that does not answer tries for so long

LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_MESSAGE}}}}
"""Of any hub; Zenoh's own is 1 GiB."""

ROBOT_LIMITS: dict[str, Any] = {"transport": {"link": {"rx": {"max_message_size": MAX_ROBOT}}}}
"""The same, where a driver waits for a robot."""

LOG = "error,zenoh_link_tls=warn,zenoh::net::routing::hat::broker::pubsub=off"
"""What Zenoh is to log in a hub with certificates: why it turned somebody away at the door is said nowhere else."""

Config = dict[str, Any]
Allow = Callable[[str, str, list[str], str], None]
"""Takes a rule: what it is called, its flow, messages and key."""


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
    by_role = {role: [entry.name for entry in keys.members if entry.role == role] for role in ("host", "observer")}
    return config | {"access_control": _access(by_role["host"], by_role["observer"])}


def driver_security(keys: "Keys", vehicle: str) -> Config:
    """The same where a driver waits for the robot of this vehicle: who has no certificate for it may greet, and no more."""
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


def hub_secret(secret: str, known: IO[bytes]) -> Config:
    """Configuration of a hub that lets in those who have its secret, which does not pass over the link.

    Args:
        known: a file of this process alone, until the session is open.
    """
    known.write(f"{OPEN}:{secret}\n".encode())
    known.seek(0)
    config = client_secret(secret)
    config["transport"]["auth"]["usrpwd"]["dictionary_file"] = f"/dev/fd/{known.fileno()}"
    return config


def client_secret(secret: str) -> Config:
    """Configuration of a host or an observer that has the secret of a run."""
    return {"transport": {"auth": {"usrpwd": {"user": OPEN, "password": secret}}}}


def machine_security(bundle: "Bundle") -> Config:
    """What the configuration of a host, an observer or a robot needs."""
    tls = {"connect_private_key_base64": _base64(bundle.key_pem), "connect_certificate_base64": _base64(bundle.certificate_pem)}
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
    from vcmvsp.cosim.security.certificates import (
        HUB,  # here, because loading the library of certificates takes a quarter of a second
    )

    for name in identifiers:
        if name != HUB:
            raise UsageError(f"what answers there is '{name}', not a run")


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


def _sees_hub(allow: Allow) -> None:
    allow("watches", "ingress", ["declare_liveliness_subscriber"], HUB_ALIVE)
    allow("sees", "egress", ["liveliness_token"], HUB_ALIVE)


def _base64(text: str) -> str:
    return base64.b64encode(text.encode()).decode()
