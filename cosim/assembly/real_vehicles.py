"""Build the real vehicles of a scenario: checks their tables."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import msgspec

from vcmvsp.cosim.assembly.resolved import Resolution, complete_positioning
from vcmvsp.cosim.clock import WallClock
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.endpoints import with_slash
from vcmvsp.cosim.federate import Log
from vcmvsp.cosim.recording.external_inputs import Input
from vcmvsp.cosim.scenario.schema import SIMULATED, RealVehicle, SafetyTable, Scenario, VehicleTable
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.hardware.federate import Hardware
    from vcmvsp.hardware.playback import Playback
    from vcmvsp.physics.vehicles.specification import Vehicle

MOST_SPEED, MOST_YAW_RATE = 1.0, 2.0  # m/s and rad/s, default limits of a robot among people; assumed
ACCEL, YAW_ACCEL = 0.3, 1.5  # m/s2 and rad/s2, of a kind that gives none: an AmigoBot's; assumed

ADDRESSES = frozenset({"port", "address", "listen"})  # parameters of drivers and localisations that no two vehicles may share
OF_DRIVER = ("driver", "localisation", "fusion", "safety")
"""Keys that only real vehicles have."""


def of_scenario(
    scenario: Scenario, source: Source, resolution: Resolution, models: "Mapping[str, Vehicle]"
) -> tuple[RealVehicle, ...]:
    """The vehicles of the scenario that have a driver, checked.

    Args:
        resolution: receives the complete tables.
        models: model of each vehicle, by name (`physics.vehicles.specification.Vehicle`).
    """
    for vehicle in scenario.vehicle:
        if vehicle.driver is None:
            _check_nothing_lost(vehicle, source)
    real = [each for each in scenario.vehicle if each.is_real]
    vehicles = tuple(_described(each, scenario, source, resolution, models[each.name]) for each in real)
    _check_addresses(vehicles, source)
    return vehicles


def _described(
    vehicle: VehicleTable, scenario: Scenario, source: Source, resolution: Resolution, model: "Vehicle"
) -> RealVehicle:
    from vcmvsp.cosim.estimation.fusion import Fusion
    from vcmvsp.hardware.stations import check_safety
    from vcmvsp.physics.vehicles.specification import flies

    key, flying = f"vehicle.{vehicle.name}", flies(model)
    if vehicle.battery is not None:
        raise source.error("a real vehicle has a real battery: leave this table out", f"{key}.battery")
    if vehicle.clock is not None:
        raise source.error("a real vehicle has a real clock: leave this table out", f"{key}.clock")
    build = _builder(vehicle.name, source, resolution, flies=flying)
    driver_table = vehicle.driver or {}
    kind, params = build("driver", driver_table, f"{key}.driver")
    tables: dict[str, Any] = {"driver": {"kind": kind, **params}}
    localisation, localisation_params = None, dict[str, Any]()
    if vehicle.localisation is not None and vehicle.localisation.get("kind") != SIMULATED:
        localisation, localisation_params = build("localisation", vehicle.localisation, f"{key}.localisation")
        tables["localisation"] = {"kind": localisation, **localisation_params}
    position, yaw = vehicle.start
    start = (position[0], position[1], yaw)
    binding.call(Fusion, vehicle.fusion, key=f"{key}.fusion", origin=source, arguments={"start": start})
    tables["fusion"] = binding.complete(Fusion, vehicle.fusion, without=("start",))
    safety = _safety(scenario.safety, vehicle, model, source)
    tables["safety"] = binding.plain(safety)
    resolution.real[vehicle.name] = tables
    described = RealVehicle(
        name=vehicle.name,
        kind=vehicle.kind,
        folder=str(source.folder.resolve()),
        driver=driver_table["kind"],
        driver_params=params,
        localisation=localisation and (vehicle.localisation or {})["kind"],
        localisation_params=localisation_params,
        fusion=tables["fusion"],
        safety=safety,
        pose_source=vehicle.pose_source,
        start=start,
        height_m=position[2],
        flies=flying,
        positioning=complete_positioning(vehicle.positioning),
        seed=scenario.seed,
        on_lost=(vehicle.agent and vehicle.agent.on_lost) or scenario.agents.on_lost,
    )
    try:
        check_safety(described)
    except ValueError as error:
        raise source.error(str(error), f"{key}.safety" if "fence" in vehicle.safety else "safety") from error
    return described


def robots(
    real: tuple[RealVehicle, ...],
    models: "Mapping[str, Vehicle]",
    *,
    run: str,
    clock: WallClock,
    tell: Tell,
    log: Log,
    connect: bool,
) -> "Hardware":
    """The federate `hardware` that drives these vehicles, which keep clear of all others."""
    from vcmvsp.hardware.federate import Hardware
    from vcmvsp.physics.vehicles.specification import body_of

    radius_m = {name: body_of(model).radius_m for name, model in models.items()}
    return Hardware(real, run=run, clock=clock, radius_m=radius_m, tell=tell, log=log, connect=connect)


def playback(scenario: Scenario, inputs: Sequence[Input], tell: Tell) -> "Playback | None":
    """The federate `hardware` that repeats the recorded real vehicles of an earlier run, or None if none was real."""
    from vcmvsp.hardware.playback import Playback

    return Playback(scenario.real, inputs, tell=tell) if scenario.real else None


def _check_addresses(vehicles: Sequence[RealVehicle], source: Source) -> None:
    """Reject two vehicles at one port."""
    users: dict[str, str] = {}
    for each in vehicles:
        for table_, params in (("driver", each.driver_params), ("localisation", each.localisation_params)):
            for name in sorted(ADDRESSES & {*params}):
                address, key = with_slash(str(params[name])), f"vehicle.{each.name}.{table_}.{name}"
                if address in users and address != "emulated" and not address.endswith(":0"):
                    raise source.error(f"'{address}' is also used by {users[address]}: each vehicle needs its own", key)
                users[address] = each.name


def _builder(
    vehicle: str, source: Source, resolution: Resolution, *, flies: bool
) -> Callable[[str, Mapping[str, Any], str], tuple[str, dict[str, Any]]]:
    """A function that checks a table by building its object and returns the kind and complete parameters."""
    offered = {"vehicle": vehicle, "folder": str(source.folder.resolve())}

    def build(group: str, content: Mapping[str, Any], key: str) -> tuple[str, dict[str, Any]]:
        built, full = resolution.component(group, content, key, offered=offered)
        if flies and getattr(built, "ground_only", False):
            raise source.error(f"is for robots on the ground, but {vehicle} flies", f"{key}.kind")
        return full.pop("kind"), full

    return build


def _check_nothing_lost(vehicle: VehicleTable, source: Source) -> None:
    """Reject keys of real vehicles at a simulated vehicle, where they would have no effect."""
    for name in OF_DRIVER[1:]:
        if name == "fusion" and vehicle.pose_source == "fusion":
            continue
        if getattr(vehicle, name):
            key = f"vehicle.{vehicle.name}.{name}"
            raise source.error("is only for real vehicles: add a driver, or leave it out", key)


def _safety(shared: SafetyTable, vehicle: VehicleTable, model: "Vehicle", source: Source) -> SafetyTable:
    """``[safety]`` of a vehicle: the shared table, the vehicle's own keys, the limits of its kind."""
    key = f"vehicle.{vehicle.name}.safety"
    own = binding.call(SafetyTable, vehicle.safety, key=key, origin=source)
    length, width, _ = model.hull.size
    ahead, aside, _ = model.hull.offset
    at_most = {
        "max_speed": min(getattr(model, "max_speed", MOST_SPEED), MOST_SPEED),
        "max_yaw_rate": min(getattr(model, "max_yaw_rate", MOST_YAW_RATE), MOST_YAW_RATE),
        "accel": getattr(model, "accel", ACCEL),
        "decel": getattr(model, "decel", ACCEL),
        "yaw_accel": getattr(model, "yaw_accel", YAW_ACCEL),
        "radius_m": math.hypot(0.5 * length + abs(ahead), 0.5 * width + abs(aside)),
    }
    values = {}
    for name in SafetyTable.__struct_fields__:
        value = getattr(own if name in vehicle.safety else shared, name)
        values[name] = at_most.get(name) if value is None else value
    return msgspec.convert(binding.plain(values), SafetyTable)
