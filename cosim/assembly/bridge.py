"""Programs outside that take part in a run: ``[bridge]`` and ``[sockets]`` checked, and handed to who knows sockets."""

from collections.abc import Sequence
from typing import Any

import msgspec

from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.federate import Federate
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.util.text import Tell


class DoorTable(msgspec.Struct, frozen=True):
    """One door."""

    name: str  # of its table, ``bridge.NAME``
    kind: str  # as it is written; default: the name
    params: dict[str, Any]  # complete


def kind_of(name: str, content: Any) -> Any:
    """The kind of a door, as it is written in its table; by default it is the table's name."""
    return content.get("kind", name) if isinstance(content, dict) else name


def doors_of(scenario: Scenario, source: Source, resolution: Resolution) -> list[DoorTable]:
    """The doors of ``[bridge]``, each built once to be checked."""
    names, found, resolved = [each.name for each in scenario.vehicle], [], dict[str, Any]()
    alone: dict[type, str] = {}  # keys of those of which there is one at most
    for name, content in scenario.bridge.doors.items():
        key = f"bridge.{name}"
        if not isinstance(content, dict):
            if name in builtin_kinds.KINDS["door"]:
                raise ScenarioError(f"must be a table, not {binding.show(content)}", key=key, source=source.of(key))
            allowed = [
                *(each for each in binding.parameters(type(scenario.bridge)) if each != "doors"),
                *builtin_kinds.KINDS["door"],
            ]
            raise ScenarioError(binding.unknown("key", name, allowed), key=key, source=source.of(key))
        kind = kind_of(name, content)
        door, full = resolution.component("door", {**content, "kind": kind}, key)
        if getattr(door, "only_one", False) and (first := alone.setdefault(type(door), key)) != key:
            problem = f"a run has one door of kind {kind} at most, and {first} is one: leave one of the two out"
            raise ScenarioError(problem, key=key, source=source.of(key))
        try:
            door.check(names)
        except ValueError as error:
            raise ScenarioError(str(error), key=key, source=source.of(key)) from error
        written = full.pop("kind")
        found.append(DoorTable(name, kind, full))
        resolved[name] = full if written == name else {"kind": written, **full}
    if found:
        resolution.tables["bridge"] = {"agents": scenario.bridge.agents, **resolved}
    return found


def bridge_of(
    doors: Sequence[DoorTable], scenario: Scenario, source: Source, *, air: Any, tell: Tell, connect: bool
) -> Federate:
    """The federate that carries what programs send.

    Args:
        doors: of the scenario.
        air: the radio.
        tell: takes lines for the user.
        connect: open the doors; else nothing is, which serves to check the scenario.
    """
    bridge: Federate = registry.piece("bridge")(
        doors,
        run=scenario.name,
        folder=str(source.folder.resolve()),
        vehicles=[each.name for each in scenario.vehicle],
        agents=scenario.bridge.agents,
        air=air,
        tell=tell,
        connect=connect,
    )
    return bridge


def programs_of(scenario: Scenario, source: Source, resolution: Resolution, *, tell: Tell, connect: bool) -> list[Federate]:
    """The federate that lets programs keep the run's own time, if any vehicle has one."""
    wanted, names, key = scenario.sockets, [each.name for each in scenario.vehicle], "sockets.vehicles"
    for name in wanted.vehicles:
        if name not in names:
            raise ScenarioError(binding.unknown("vehicle", name, names), key=key, source=source.of(key))
        if wanted.vehicles.count(name) > 1:
            raise ScenarioError(f"names {name} twice; each has one program", key=key, source=source.of(key))
    if not wanted.vehicles:
        return []
    resolution.tables["sockets"] = binding.plain(wanted)
    try:
        return [registry.piece("socket server")(wanted, names, tell=tell, connect=connect)]
    except ValueError as error:
        raise ScenarioError(str(error), key="sockets.listen", source=source.of("sockets.listen")) from error
