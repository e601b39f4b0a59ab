"""Build the federates of external programs: checks ``[bridge]`` and ``[sockets]``."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.clock import WallClock
from vcmvsp.cosim.config import binding, builtin_kinds
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.federate import Event, Log
from vcmvsp.cosim.recording.external_inputs import EventPlayback, Input
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.types import Datagrams
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.netsim.bridge.federate import Bridge
    from vcmvsp.netsim.bridge.messages import GatewaySpec
    from vcmvsp.netsim.federate import RadioFederate
    from vcmvsp.netsim.sockets.federate import Programs


class ProgramFederates(NamedTuple):
    """The federates that exchange messages with programs."""

    in_run_time: "Programs | None"  # programs in simulated time
    bridge: "Bridge | None"  # programs in wall time
    playback: EventPlayback | None  # recorded datagrams of such programs


def of_scenario(
    scenario: Scenario,
    source: Source,
    resolution: Resolution,
    *,
    airs: "Sequence[RadioFederate]",
    clock: WallClock,
    bridged: Sequence[Input] | None,
    tell: Tell,
    log: Log,
    connect: bool,
) -> ProgramFederates:
    """Build the federates of ``[sockets]`` and ``[bridge]``.

    Args:
        bridged: datagrams recorded from the programs of an earlier run, which replace the programs.
        log: receives the datagrams, for a replay.
        connect: open the gateways; False only checks the scenario.
    """
    # Programs in simulated time run again in a replay.
    programs = programs_of(scenario, source, resolution, tell=tell, connect=connect or bridged is not None)
    doors = doors_of(scenario, source, resolution)
    if bridged is not None:
        datagrams = [Event(key, time_ns, value) for key, time_ns, value in bridged if isinstance(value, Datagrams)]
        return ProgramFederates(programs, None, EventPlayback("bridge", datagrams))
    if not doors:
        return ProgramFederates(programs, None, None)
    from vcmvsp.netsim.bridge.federate import Bridge, BridgeRadio

    of_radio = {name: air for air in airs for name in air.networks}
    radios = {name: BridgeRadio(own, of_radio[name].levels_dbm) for name, own in scenario.radio_members.items()}
    bridge = Bridge(
        doors,
        run=scenario.name,
        folder=str(source.folder.resolve()),
        vehicles=[each.name for each in scenario.vehicle],
        agents=scenario.bridge.agents,
        levels_dbm=airs[0].levels_dbm,
        clock=clock,
        tell=tell,
        log=log,
        connect=connect,
        radios=radios,
    )
    return ProgramFederates(programs, bridge, None)


def kind_of(name: str, content: Any) -> Any:
    """The kind of a gateway: ``kind`` of its table, by default the table's name."""
    return content.get("kind", name) if isinstance(content, dict) else name


def doors_of(scenario: Scenario, source: Source, resolution: Resolution) -> "list[GatewaySpec]":
    """The gateways of ``[bridge]``, each built once as a check."""
    if scenario.bridge.doors:
        from vcmvsp.netsim.bridge.messages import GatewaySpec
    names, gateways, resolved = [each.name for each in scenario.vehicle], [], dict[str, Any]()
    alone: dict[type, str] = {}  # keys of the kinds that allow one gateway only
    for name, content in scenario.bridge.doors.items():
        key = f"bridge.{name}"
        if not isinstance(content, dict):
            if name in builtin_kinds.KINDS["door"]:
                raise source.error(f"must be a table, not {binding.show(content)}", key)
            allowed = {*binding.parameters(type(scenario.bridge)), *builtin_kinds.KINDS["door"]} - {"doors"}
            raise source.error(binding.unknown("key", name, allowed), key)
        kind = kind_of(name, content)
        own = {name: value for name, value in content.items() if name != "radio" or not scenario.radios}
        door, full = resolution.component("door", {**own, "kind": kind}, key)
        if getattr(door, "only_one", False) and (first := alone.setdefault(type(door), key)) != key:
            raise source.error(f"a run has at most one gateway of kind {kind}, and {first} is one: leave one out", key)
        radio = _radio_of(scenario, source, key, content, door)
        try:
            door.check(names)
            if scenario.radios and hasattr(door, "check_radios"):
                members = scenario.radio_members
                door.check_radios({radio: members[radio]} if radio else members)
        except ValueError as error:
            raise source.error(str(error), key) from error
        written = full.pop("kind")
        gateways.append(GatewaySpec(name=name, kind=kind, params=full, radio=radio))
        chosen = {"radio": radio} if radio else {}
        resolved[name] = {**chosen, **full} if written == name else {"kind": written, **chosen, **full}
    if gateways:
        resolution.tables["bridge"] = {"agents": scenario.bridge.agents, **resolved}
    return gateways


def _radio_of(scenario: Scenario, source: Source, key: str, content: Mapping[str, Any], door: object) -> str:
    """The radio of a gateway, of several: that of its table, or the first; empty: the only one, or all."""
    if not scenario.radios:
        return ""
    radio = content.get("radio", "" if getattr(door, "every_radio", False) else next(iter(scenario.radios)))
    if radio and radio not in scenario.radios:
        raise source.error(binding.unknown("radio", str(radio), list(scenario.radios)), f"{key}.radio")
    return str(radio)


def programs_of(scenario: Scenario, source: Source, resolution: Resolution, *, tell: Tell, connect: bool) -> "Programs | None":
    """The federate of programs in simulated time, or None if no vehicle has such a program."""
    table, names, key = scenario.sockets, [each.name for each in scenario.vehicle], "sockets.vehicles"
    for name in table.vehicles:
        if name not in names:
            raise source.error(binding.unknown("vehicle", name, names), key)
        if table.vehicles.count(name) > 1:
            raise source.error(f"contains {name} twice; a vehicle has one program", key)
        for radio, members in list(scenario.radio_members.items())[:1]:
            if name not in members:
                raise source.error(f"{name} has no radio {radio}: programs use the first one; put its table first", key)
    if not table.vehicles:
        return None
    from vcmvsp.netsim.sockets.federate import Programs

    resolution.tables["sockets"] = binding.plain(table)
    try:
        return Programs(table, names, tell=tell, connect=connect)
    except ValueError as error:
        raise source.error(str(error), "sockets.listen") from error
