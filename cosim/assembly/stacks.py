"""Build the stacks of a scenario, ``[stack.KIND]``: programs that drive simulated vehicles in place of agents."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.builtin_kinds import KINDS
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.federate import Stack
from vcmvsp.cosim.frames import Quaternion
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.types import ORIGIN, Vec3
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.physics.sensors.sensor import Sensor
    from vcmvsp.physics.vehicles.specification import Vehicle


class Stacks(NamedTuple):
    """The stacks of a scenario."""

    by_place: Mapping[str, Stack]  # by ``stack.KIND``
    place: Mapping[str, str]  # of each vehicle that has one


def of_scenario(
    scenario: Scenario,
    source: Source,
    resolution: Resolution,
    models: "Mapping[str, Vehicle]",
    sensors: "Mapping[str, Mapping[str, Sensor]]",
    *,
    tell: Tell,
) -> Stacks:
    """Build the stacks. They open their connections when the run starts.

    Args:
        resolution: receives the complete tables.
        models: model of each vehicle, by name.
        sensors: sensors of each vehicle, by name.
    """
    from vcmvsp.physics.vehicles.specification import flies

    stacks, place = dict[str, Stack](), dict[str, str]()
    names = [each.name for each in scenario.vehicle]
    for kind, content in scenario.stack.items():
        key = f"stack.{kind}"
        if kind not in KINDS["stack"]:
            raise source.error(binding.unknown("stack", kind, KINDS["stack"]), key)
        if not isinstance(content, dict):
            raise source.error(f"must be a table, not {binding.show(content)}", key)
        flying = [name for name, model in models.items() if flies(model)]
        offered = {
            "flying": frozenset(flying),
            "mounts": {f"{name}/{sensor}": _mount(each) for name, own in sensors.items() for sensor, each in own.items()},
            "deadline_s": scenario.agents.deadline_s,
            "join_timeout_s": scenario.agents.join_timeout_s,
            "tell": tell,
        }
        stacks[key], full = resolution.component("stack", {**content, "kind": kind}, key, offered=offered)
        resolution.tables.setdefault("stack", {})[kind] = {name: each for name, each in full.items() if name != "kind"}
        for name in stacks[key].vehicles:
            if name not in names:
                raise source.error(binding.unknown("vehicle", name, names), f"{key}.vehicles")
            if name in scenario.real:
                raise source.error(f"drives simulated vehicles, and {name} is real", f"{key}.vehicles")
            if place.setdefault(name, key) != key or stacks[key].vehicles.count(name) > 1:
                raise source.error(f"{name} is driven twice", f"{key}.vehicles")
    return Stacks(stacks, place)


def paced(scenario: Scenario) -> bool:
    """Whether a stack needs the pace of the wall clock."""
    return any(isinstance(each, dict) and each.get("pace") != "lockstep" for each in scenario.stack.values())


def _mount(sensor: Any) -> tuple[Vec3, Quaternion]:
    """Place (m) and attitude of a sensor's frame in the body's; of a camera, whose z axis is the optical one."""
    from scipy.spatial.transform import Rotation  # slow import

    place, rotation = getattr(sensor, "mount", ORIGIN), getattr(sensor, "body_from_camera", np.eye(3))
    if isinstance(place, np.ndarray):  # of a range scanner, (3, 4)
        place, rotation = place[:, 0].tolist(), place[:, 1:]
    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return (place[0], place[1], place[2]), (w, x, y, z)
