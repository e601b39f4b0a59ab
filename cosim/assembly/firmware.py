"""Build the firmware that flies simulated quadrotors of a scenario: checks its tables."""

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING

from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.scenario.schema import Scenario, VehicleTable
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.hardware.firmware.link import FirmwareLink
    from vcmvsp.hardware.firmware.lock_step import LockStepFirmware
    from vcmvsp.physics.vehicles.specification import Vehicle


def of_scenario(
    scenario: Scenario, source: Source, resolution: Resolution, models: "Mapping[str, Vehicle]", *, tell: Tell
) -> "LockStepFirmware | None":
    """The firmware of all vehicles that have some; None: none has. It opens its ports at the first step.

    Args:
        resolution: receives the complete tables.
        models: model of each vehicle, by name.
    """
    links: dict[str, FirmwareLink] = {}
    users: dict[int, str] = {}
    numbers: Counter[str] = Counter()  # vehicles by kind of firmware
    for vehicle in scenario.vehicle:
        if vehicle.firmware is None:
            continue
        key = f"vehicle.{vehicle.name}.firmware"
        _check_vehicle(vehicle, models[vehicle.name], key, source)
        kind = str(vehicle.firmware.get("kind"))
        offered = {"vehicle": vehicle.name, "number": numbers[kind], "folder": str(source.folder.resolve())}
        numbers[kind] += 1
        link, table = resolution.component("firmware", vehicle.firmware, key, offered=offered)
        if link.has_sticks and link.mavlink:
            raise source.error(
                "takes no commands over MAVLink, but those of the vehicle's agent by itself: leave it out", f"{key}.mavlink"
            )
        if vehicle.agent is not None and not (link.mavlink or link.has_sticks):
            problem = "is missing: the agent's commands reach the firmware over MAVLink"
            raise source.error(f"{problem}, e.g. mavlink = 'udpin:127.0.0.1:14540'; or leave the agent out", f"{key}.mavlink")
        if link.port in users and not link.is_alone:
            raise source.error(f"its port {link.port} is that of {users[link.port]}", f"{key}.instance")
        if not link.is_alone:
            users[link.port] = vehicle.name
        links[vehicle.name], resolution.firmware[vehicle.name] = link, table
    if not links:
        return None
    from vcmvsp.hardware.firmware.lock_step import LockStepFirmware

    return LockStepFirmware(links, tell)


def _check_vehicle(vehicle: VehicleTable, model: "Vehicle", key: str, source: Source) -> None:
    from vcmvsp.physics.vehicles.models import Quadrotor

    if vehicle.is_real:
        raise source.error("is only for simulated vehicles: leave it or the driver out", key)
    if not isinstance(model, Quadrotor):
        raise source.error(f"flies quadrotors, not a {vehicle.kind}", key)
