"""From ``[radio]`` to a channel: a preset, and what is changed of its layers."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.config import binding, builtin_kinds, factory, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import Scenario


class Built(msgspec.Struct, frozen=True):
    """The radio of a scenario."""

    federate: Any  # `netsim.federate.RadioFederate`
    channel: Any  # `netsim.channel.channel.Channel`
    radios: Mapping[str, Any]  # `netsim.interfaces.radio.Radio`, by vehicle
    resolved: dict[str, dict[str, Any]]  # ``[radio]`` and, where somebody passes messages on, ``[routing]``: complete


def of_scenario(
    scenario: Scenario,
    source: Source,
    *,
    solids: Any,
    portable: factory.Portable = str,
    keep: factory.Keep = factory.name_of,
    recorded: Path | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Built:
    """Build the radio of a scenario.

    Args:
        scenario, source, solids, portable, keep: as for `build`.
        recorded: ``radio.parquet`` of an earlier run: its frames fare as they did then.
        tell: takes lines for the user.
    """
    kind, federate = registry.piece("vehicle radio"), registry.piece("radio")
    radios = {
        each.name: binding.call(kind, each.radio, key=f"vehicle.{each.name}.radio", origin=source) for each in scenario.vehicle
    }
    keys = [name for name in binding.parameters(federate) if name not in ("channel", "router")]
    own = {name: value for name, value in scenario.radio.items() if name in keys}
    layers = {name: value for name, value in scenario.radio.items() if name not in keys}
    channel, resolved = build(
        layers, source, solids=solids, radios=radios, vehicles=list(radios), portable=portable, keep=keep, also=keys
    )
    air = channel if recorded is None else registry.piece("recorded radio")(channel, recorded, tell)
    router, routing = None, dict[str, Any]()
    if scenario.routing:
        router, routing = factory.build("routing", scenario.routing, key="routing", source=source, portable=portable, keep=keep)
    built = binding.call(federate, own, key="radio", origin=source, given={"channel": air, "router": router})
    full = {**binding.complete(federate, own, without=("channel", "router")), **resolved}
    return Built(built, channel, radios, {"radio": full, **({"routing": routing} if router is not None else {})})


def build(
    radio: Mapping[str, Any],
    source: Source,
    *,
    key: str = "radio",
    solids: Any = (),
    radios: Mapping[str, Any] | None = None,
    vehicles: Sequence[str] = (),
    portable: factory.Portable = str,
    keep: factory.Keep = factory.name_of,
    also: Sequence[str] = (),
) -> tuple[Any, dict[str, Any]]:
    """Build a channel.

    Args:
        radio: ``preset``, and a table for each layer that is to be changed.
        source: where that came from.
        key: path of the table in the scenario; empty: the layers stand at the top.
        solids: what stands in the world.
        radios: what vehicles have of their own, by name.
        vehicles: names of all.
        portable: how the resolved scenario names a kind.
        also: other keys that may stand in this table, for messages.
        keep: keeps a file that the scenario uses; how the resolved scenario names it.

    Returns:
        The `netsim.channel.channel.Channel`, and the table with everything filled in.
    """
    presets = registry.piece("radio presets")
    for name in radio:
        if name not in ("preset", *presets.LAYERS):
            where = binding.join(key, name)
            problem = binding.unknown("key", name, ["preset", *also, *presets.LAYERS])
            raise ScenarioError(problem, key=where, source=source.of(where))
    preset = radio.get("preset", "ideal")
    if preset not in presets.PRESETS:
        where = binding.join(key, "preset")
        raise ScenarioError(binding.unknown("preset", str(preset), presets.PRESETS), key=where, source=source.of(where))
    base, layers, resolved = presets.preset(preset), {}, {"preset": preset}
    offered = {"sightline": registry.piece("sightline")(solids)}
    for name in presets.LAYERS:
        where, own = binding.join(key, name), radio.get(name, {})
        if not isinstance(own, dict):
            raise ScenarioError(f"must be a table, not {binding.show(own)}", key=where, source=source.of(where))
        content = _merged(name, base[name], own)
        layers[name], resolved[name] = factory.build(
            name, content, key=where, source=source, portable=portable, offered=offered, keep=keep
        )
        if name == "phy":
            offered["noise_dbm"] = getattr(layers["phy"], "noise_dbm", None)
    _check_mac(layers, key, source)
    _check_names(layers, vehicles, key, source)
    return registry.piece("channel")(**layers, radios=radios), resolved


def _merged(layer: str, base: Mapping[str, Any], own: Mapping[str, Any]) -> Mapping[str, Any]:
    """The preset's table with what is changed of it; another kind has a table of its own."""
    if (
        own and base["kind"] == "none" and len(builtin_kinds.KINDS[layer]) == 2
    ):  # it can be left out, or be the one that there is
        return {"kind": next(iter(builtin_kinds.KINDS[layer])), **own}
    return {**base, **own} if own.get("kind", base["kind"]) == base["kind"] else own


def _check_mac(layers: Mapping[str, Any], key: str, source: Source) -> None:
    """A mac may need a phy of its own standard."""
    try:
        layers["mac"].open(layers["phy"], 2, np.zeros(2, np.uint64), 1e-9)
    except ScenarioError as error:
        where = binding.join(key, "mac.kind")
        named = source.of(where)
        named = source.of(binding.join(key, "phy")) if named == source.name else named  # one of both was changed
        raise ScenarioError(error.problem, key=where, source=named) from error


def _check_names(layers: Mapping[str, Any], vehicles: Sequence[str], key: str, source: Source) -> None:
    """Layers that name vehicles must mean those that there are."""
    for layer in ("trace", "jammer"):
        for name in layers[layer].names() if layers[layer] else ():
            if name not in vehicles:
                where = binding.join(key, layer)
                raise ScenarioError(binding.unknown("vehicle", name, vehicles), key=where, source=source.of(where))
    for expression in layers["script"].unmatched(vehicles) if layers["script"] else ():
        where = binding.join(key, "script.changes")
        problem = f"links = {expression!r} stands for no link; vehicles: {', '.join(vehicles)}"
        raise ScenarioError(problem, key=where, source=source.of(where))
