"""Who may join a run, and as what: a host's greeting against what the scenario says."""

import contextlib
import os
from collections.abc import Collection, Mapping
from typing import Any

import msgspec

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.hosts.protocol import Hello


def refusal(hello: Hello, waiting: Mapping[str, AgentSpec], expected: Collection[str]) -> str | None:
    """Why a host that knocks may not come in; None: it may."""
    if len(set(hello.vehicles)) < len(hello.vehicles):
        return "it names a vehicle twice"
    for vehicle in hello.vehicles:
        if vehicle not in expected:
            return f"{binding.unknown('vehicle', vehicle, expected)}, or its agent runs elsewhere"
        if vehicle not in waiting:
            return f"the agent of '{vehicle}' has joined already, or is not to come back"
        if hello.kind is None and not waiting[vehicle].kind:
            return f"the scenario names no agent for '{vehicle}': start the host with MODULE_OR_FILE:Class"
    return None if hello.vehicles else "it names no vehicle"


def late_refusal(hello: Hello, specs: Mapping[str, AgentSpec], lost: Collection[str], *, together: bool) -> str | None:
    """Why a host that comes when the run has begun may not come in; None: it may.

    Args:
        hello: its greeting.
        specs: the agents that are hosted elsewhere.
        lost: vehicles that may have another host.
        together: whether all that it names were at one host.
    """
    free = {vehicle: spec for vehicle, spec in specs.items() if vehicle in lost}
    if why := refusal(hello, free, specs):
        return why
    for vehicle in hello.vehicles:
        spec = specs[vehicle]
        if hello.kind is not None and not _same(hello.kind, spec.kind):
            return f"the run has begun with {spec.kind} for '{vehicle}', and takes no other agent"
        if any(spec.params.get(name) != value for name, value in hello.params.items()):
            return "the run has begun, and takes no other parameters: leave out --set"
    return None if together else f"the run has begun with {', '.join(hello.vehicles)} at several hosts: start one for each"


def at_its_place(spec: AgentSpec, hello: Hello) -> AgentSpec:
    """The spec for a host that comes later: the same class may be in another folder on its machine."""
    return spec if hello.kind is None else msgspec.structs.replace(spec, kind=hello.kind, folder=hello.folder)


def as_host_says(spec: AgentSpec, hello: Hello, kinds: dict[str, str]) -> AgentSpec:
    """The spec with what the host was told on its own command line; another class than the scenario's is noted in ``kinds``."""
    params: dict[str, Any] = dict(hello.params)
    if hello.kind is None or _same(hello.kind, spec.kind):
        kind, folder = (hello.kind, hello.folder) if hello.kind else (spec.kind, spec.folder)
        return msgspec.structs.replace(spec, kind=kind, folder=folder, params={**spec.params, **params})
    kinds[spec.vehicle] = hello.kind
    # Another class than the scenario's: the scenario's parameters are for it where it takes them.
    defaults = {**spec.defaults, **spec.params}
    return msgspec.structs.replace(spec, kind=hello.kind, folder=hello.folder, params=params, defaults=defaults)


def _same(one: str, other: str) -> bool:
    """Whether two kinds name the same class; of files only the name counts, since folders differ between machines."""
    return _target(one) == _target(other)


def _target(kind: str) -> str:
    if registry.is_file_kind(kind):
        return os.path.basename(kind)  # noqa: PTH119  of "folder/file.py:Class", which is no path
    with contextlib.suppress(VcmvspError):
        return registry.target("agent", kind)
    return kind
