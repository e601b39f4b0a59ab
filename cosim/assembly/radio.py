"""Build the channel from ``[radio]``: a preset with changed layers."""

import contextlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import Scenario, VehicleTable
from vcmvsp.cosim.util.text import Tell
from vcmvsp.netsim.presets import LAYERS, PRESETS
from vcmvsp.netsim.presets import preset as preset_of

if TYPE_CHECKING:
    from vcmvsp.netsim.channel.channel import Channel
    from vcmvsp.netsim.federate import Network, RadioFederate
    from vcmvsp.netsim.interfaces.layers import Radio
    from vcmvsp.physics.world.solids import AnySolid


GIVEN = ("channel", "router", "programs", "woken", "reported_from_dbm", "networks", "numbers", "notify")
"""Parameters of the federate that are no keys of ``[radio]``."""


def federates_of(
    scenario: Scenario,
    source: Source,
    resolution: Resolution,
    *,
    solids: "Sequence[AnySolid]",
    recorded: Path | None,
    programs: bool,
    tell: Tell,
) -> "list[RadioFederate]":
    """The federate `radio` of a scenario; of several radios, one for each channel.

    Args:
        resolution: receives the complete ``[radio]`` and ``[routing]``.
        recorded: ``radio.parquet`` of an earlier run, whose frame outcomes are repeated.
        programs: whether programs in wall time take part; they may send any number of frames.
    """
    from vcmvsp.netsim.federate import Network

    build_one = partial(_federate, source=source, resolution=resolution, solids=solids, programs=programs, tell=tell)
    if not scenario.radios:
        return [build_one(scenario, recorded=recorded)]
    routed = _routed_radio(scenario, source)
    channels: dict[Any, list[Network]] = {}
    for name, members in scenario.radio_members.items():
        is_first = name == next(iter(scenario.radios))
        channels.setdefault(scenario.radios[name].get("channel", name), []).append(Network(name, members, is_first))
    numbers, federates, tables = itertools.count(), [], dict[str, Any]()
    for networks in channels.values():
        first = networks[0].name
        _check_one_each(networks, source)
        if routed in {each.name for each in networks} and len(networks) > 1:
            others = ", ".join(each.name for each in networks if each.name != routed)
            raise source.error(f"{routed} shares its channel with {others}: give it a channel of its own", "routing.radio")
        own = scenario.with_radio(first)
        if first != routed:
            own = msgspec.structs.replace(own, routing={})
        federates.append(build_one(own, key=f"radio.{first}", networks=networks, recorded=recorded, numbers=numbers))
        complete = resolution.tables["radio"]
        for name, *_ in networks:
            if name != first:
                other = msgspec.structs.replace(scenario.with_radio(name), routing={})
                build_one(other, key=f"radio.{name}", networks=networks)
            if resolution.tables["radio"] != complete:
                problem = f"has the channel of {first} and must have its keys, too: both are one medium"
                raise source.error(f"{problem}; or give it another channel", f"radio.{name}")
            own_keys = {key: value for key, value in scenario.radios[name].items() if key in ("name", "channel")}
            tables[name] = {**own_keys, **complete}
    resolution.tables["radio"] = [tables[name] for name in scenario.radios]
    return federates


def _routed_radio(scenario: Scenario, source: Source) -> str | None:
    """The radio over which messages are forwarded, of several radios; None: none."""
    if not scenario.routing or scenario.routing.get("kind") == "none":
        return None
    name = scenario.routing.get("radio")
    if name is None:
        problem = f"is missing: messages are forwarded over one radio; choose one of {', '.join(scenario.radios)}"
        raise source.error(problem, "routing.radio")
    if name not in scenario.radios:
        raise source.error(binding.unknown("radio", str(name), list(scenario.radios)), "routing.radio")
    return str(name)


def check_of_changes(airs: "Sequence[RadioFederate]") -> Callable[[str, float, Sequence[tuple[str, float]]], None]:
    """A check of a change of a radio's key during the run, after earlier ones; it raises `ValueError`."""

    def check(key: str, value: float, earlier: Sequence[tuple[str, float]]) -> None:
        of = {each: air for air in airs for each in air.adjustable()}
        if key not in of:
            raise ValueError(f"{key} cannot change during a run; keys that can: {', '.join(of) or 'none'}")
        of[key].check_change(key, value, earlier)

    return check


def _check_one_each(networks: "Sequence[Network]", source: Source) -> None:
    """Check that no vehicle has two radios on one channel."""
    for first, second in itertools.combinations(networks, 2):
        if both := sorted({*first.members} & {*second.members}):
            problem = (
                f"{both[0]} has also {first.name}, on the same channel: list its radios (radios = [...]) or use another channel"
            )
            raise source.error(problem, f"radio.{second.name}.channel")


def _federate(
    scenario: Scenario,
    source: Source,
    resolution: Resolution,
    *,
    solids: "Sequence[AnySolid]",
    programs: bool,
    tell: Tell,
    recorded: Path | None = None,
    key: str = "radio",
    networks: "Sequence[Network]" = (),
    numbers: Iterator[int] | None = None,
) -> "RadioFederate":
    """The federate of a scenario with one radio, with the table at ``key``."""
    from vcmvsp.netsim.channel.replayed import RecordedFrames
    from vcmvsp.netsim.federate import RadioFederate

    portable, keep = resolution.portable, resolution.keep
    channel, _, resolved = channel_of(scenario, source, solids=solids, portable=portable, keep=keep, key=key)
    own_networks = [(each.name, each.members) for each in networks]
    channel.recorded = None if recorded is None else RecordedFrames(recorded, tell, own_networks)
    for line in _enclosed(channel, scenario):
        tell(line)
    router = None
    if scenario.routing:
        content = {name: value for name, value in scenario.routing.items() if name != "radio" or not networks}
        router, resolution.tables["routing"] = resolution.component("routing", content, "routing")
        if networks:
            resolution.tables["routing"] = {"radio": networks[0].name, **resolution.tables["routing"]}
    keys = _federate_keys()
    own = {name: value for name, value in scenario.first_radio.items() if name in keys}
    arguments = {
        "channel": channel,
        "router": router,
        "programs": programs,
        "woken": scenario.sockets.vehicles,
        "reported_from_dbm": scenario.record.least_rssi_dbm,
        "networks": networks,
        "numbers": numbers,
        "notify": tell,
    }
    federate: RadioFederate = binding.call(RadioFederate, own, key=key, origin=source, arguments=arguments)
    resolution.tables["radio"] = {**binding.complete(RadioFederate, own, without=arguments), **resolved}
    return federate


def channel_of(
    scenario: Scenario,
    source: Source,
    *,
    solids: "Sequence[AnySolid]",
    portable: registry.Portable = str,
    keep: registry.Keep = registry.name_of,
    key: str = "radio",
) -> "tuple[Channel, Mapping[str, Radio], dict[str, Any]]":
    """The channel of a scenario with one radio, the radio of each vehicle, the complete ``[radio]``; arguments: see `build`."""
    from vcmvsp.netsim.interfaces.layers import Radio

    radios: dict[str, Radio] = {each.name: _own_radio(each, source) for each in scenario.vehicle}
    keys = _federate_keys()
    layers = {name: value for name, value in scenario.first_radio.items() if name not in keys}
    channel, resolved = build(
        layers, source, key=key, solids=solids, radios=radios, vehicles=list(radios), portable=portable, keep=keep, also=keys
    )
    return channel, radios, resolved


def _own_radio(vehicle: VehicleTable, source: Source) -> "Radio":
    """The radio of a vehicle; its antenna's file exists and is valid."""
    from vcmvsp.netsim.interfaces.layers import Radio
    from vcmvsp.netsim.propagation.antennas import pattern_of

    key = f"vehicle.{vehicle.name}.radio"
    radio: Radio = binding.call(Radio, registry.with_real_paths(Radio, vehicle.radio, source, key), key=key, origin=source)
    try:
        pattern_of(radio)
    except ScenarioError as error:
        raise source.error(error.problem, binding.join(key, error.key)) from error
    return radio


def _enclosed(channel: "Channel", scenario: Scenario) -> Iterator[str]:
    """A line on antennas that start inside a solid, where rays find no way out of it."""
    rays: Any = channel.budgets.path_loss
    if scenario.first_radio.get("path_loss", {}).get("kind") != "rays" or not scenario.vehicle:
        return
    names = tuple(each.name for each in scenario.vehicle)
    antennas = np.array([each.start[0] for each in scenario.vehicle]) + channel.budgets.antennas_above(names)
    inside = [f"{name} in {solid}" for name, solid in zip(names, rays.holder(antennas), strict=True) if solid]
    if inside:
        yield f"radio.path_loss: {len(inside)} antennas start inside a solid, reached over the roofs only: {'; '.join(inside)}"


def _federate_keys() -> list[str]:
    """Keys of ``[radio]`` that are not layers of the channel."""
    from vcmvsp.netsim.federate import RadioFederate

    return [name for name in binding.parameters(RadioFederate) if name not in GIVEN]


def build(
    radio: Mapping[str, Any],
    source: Source,
    *,
    key: str = "radio",
    solids: "Sequence[AnySolid]" = (),
    radios: "Mapping[str, Radio] | None" = None,
    vehicles: Sequence[str] = (),
    portable: registry.Portable = str,
    keep: registry.Keep = registry.name_of,
    also: Sequence[str] = (),
) -> "tuple[Channel, dict[str, Any]]":
    """Build a channel.

    Args:
        radio: ``preset``, and a table for each changed layer.
        key: path of the table in the scenario; empty: the layers are top-level keys.
        radios: radio parameters of single vehicles, by name.
        also: other keys allowed in this table, for messages.
        keep: keeps a file that the scenario uses; returns its name in the resolved scenario.

    Returns:
        The `netsim.channel.channel.Channel`, and the complete table.
    """
    from vcmvsp.netsim.channel import user_layers
    from vcmvsp.netsim.channel.channel import Channel
    from vcmvsp.physics.raycast.line_of_sight import Sightline
    from vcmvsp.physics.raycast.surfaces import SolidSurfaces

    for name in radio:
        if name not in ("preset", *LAYERS):
            problem = binding.unknown("key", name, ["preset", *also, *LAYERS])
            raise source.error(problem, binding.join(key, name))
    preset = radio.get("preset", "ideal")
    if preset not in PRESETS:
        raise source.error(binding.unknown("preset", str(preset), PRESETS), binding.join(key, "preset"))
    base, offered = preset_of(preset), {"sightline": Sightline(solids), "solids": SolidSurfaces(solids)}
    _check_rays(base, radio, key, source)
    tables = _tables(base, radio, key, source)
    try:
        layers, resolved = _layers(tables, offered, key=key, source=source, portable=portable, keep=keep)
        _check_mac(layers, key, source)
        _check_names(layers, vehicles, key, source)
        return Channel(**layers, radios=radios), {"preset": preset, **resolved}
    except user_layers.LayerError as error:
        raise source.error(error.cause, binding.join(key, error.layer)) from error


def _tables(
    base: Mapping[str, Mapping[str, Any]], radio: Mapping[str, Any], key: str, source: Source
) -> dict[str, Mapping[str, Any]]:
    """The table of each layer: the preset's with the changes of the scenario."""
    tables = {}
    for name in LAYERS:
        where, own = binding.join(key, name), radio.get(name, {})
        if not isinstance(own, dict):
            raise source.error(f"must be a table, not {binding.show(own)}{_proposal(name, base[name], own, where)}", where)
        tables[name] = _merged(name, base[name], own)
    return tables


def _layers(
    tables: Mapping[str, Mapping[str, Any]], offered: dict[str, Any], *, key: str, **options: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The layers of a channel, and their complete tables; a layer is offered to later ones that have a parameter for it."""
    from vcmvsp.netsim.channel import user_layers

    layers, resolved = {}, {}
    for name, content in tables.items():
        where, guard = binding.join(key, name), partial(user_layers.guarded, name)
        layers[name], resolved[name] = registry.build(name, content, key=where, offered=offered, guard=guard, **options)
        user_layers.check_attributes(name, layers[name])
        if name == "path_loss":
            offered["rays"] = layers[name]
        if name == "phy":
            offered["noise_dbm"] = getattr(layers["phy"], "noise_dbm", None)
    return layers, resolved


def _check_rays(base: dict[str, dict[str, Any]], radio: Mapping[str, Any], key: str, source: Source) -> None:
    """Leave out the preset's walls beside rays, which pass through walls themselves; check what needs rays, or has no place."""

    def kind_of(layer: str) -> object:
        own = radio.get(layer, {})
        return _merged(layer, base[layer], own).get("kind") if isinstance(own, dict) else None

    rays = kind_of("path_loss") == "rays"
    if rays:
        base["walls"] = {"kind": "none"}
        if radio.get("walls", base["walls"]) != base["walls"]:
            problem = "walls have no place beside path_loss.kind = 'rays', which passes through walls itself"
            raise source.error(f"{problem}: leave them out", binding.join(key, "walls"))
    elif kind_of("fading") == "geometric":
        problem = f"kind = 'geometric' needs path_loss.kind = 'rays', not {kind_of('path_loss')!r}"
        raise source.error(problem, binding.join(key, "fading.kind"))


def _proposal(layer: str, base: Mapping[str, Any], own: object, where: str) -> str:
    """A proposal for a value in place of a layer's table: its first key that may have such a value; empty if it has none."""
    content = _merged(layer, base, {})
    kinds = [kind for kind in (content["kind"], *builtin_kinds.KINDS[layer]) if kind != "none"]
    for kind in kinds:
        for name, parameter in binding.parameters(registry.find(layer, kind)).items():
            with contextlib.suppress(ScenarioError):
                binding.convert(own, parameter.annotation)
                return f"; did you mean {where}.{name} = {binding.show(own)}?"
    return ""


def _merged(layer: str, base: Mapping[str, Any], own: Mapping[str, Any]) -> Mapping[str, Any]:
    """The preset's table of a layer with its changes; a table of another kind replaces it."""
    kinds = [kind for kind in builtin_kinds.KINDS[layer] if kind != "none"]
    if own and base["kind"] == "none" and len(kinds) == 1:
        return {"kind": kinds[0], **own}
    return {**base, **own} if own.get("kind", base["kind"]) == base["kind"] else own


def _check_mac(layers: Mapping[str, Any], key: str, source: Source) -> None:
    """Check that the phy fits the mac: a mac may require a phy of its own standard."""
    try:
        layers["mac"].open(layers["phy"], 2, np.zeros(2, np.uint64), 1e-9)
    except ScenarioError as error:
        where = binding.join(key, error.key if error.key.startswith("mac.") else "mac.kind")
        origin = source.of(where)
        origin = source.of(binding.join(key, "phy")) if origin == source.name else origin  # only one of them was changed
        raise ScenarioError(error.problem, key=where, source=origin) from error


def _check_names(layers: Mapping[str, Any], vehicles: Sequence[str], key: str, source: Source) -> None:
    """Check that layers name existing vehicles only."""
    for layer in ("trace", "jammer", "mac"):
        for name in getattr(layers[layer], "names", tuple)():  # a user class may lack it
            if name not in vehicles:
                raise source.error(binding.unknown("vehicle", name, vehicles), binding.join(key, layer))
    for expression in getattr(layers["script"], "unmatched", lambda _: ())(vehicles):
        where = binding.join(key, "script.changes")
        raise source.error(f"links = {expression!r} matches no link; vehicles: {', '.join(vehicles)}", where)
