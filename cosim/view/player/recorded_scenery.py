"""What stood around the vehicles of a recorded run, as far as its folder can tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from vcmvsp.cosim.assembly import worlds
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import frozen
from vcmvsp.cosim.view.messages import Craft, Scenery
from vcmvsp.cosim.view.scenery import scenery_of

if TYPE_CHECKING:
    from vcmvsp.cosim.assembly.worlds import World

MAY = ("pace", "seek", "sensors")
"""Orders that a recording obeys."""
DEFAULT_RADIUS_M = 0.25  # of a vehicle that is not drawn in the recording


@dataclass(frozen=True)
class Stage:
    """Where a recorded run took place.

    Attributes:
        scenery: what the control station is told once.
        world: that of the run; None: it is not to be had.
    """

    scenery: Scenery
    world: "World | None" = None


def stage_of(path: Path, vehicles: Sequence[str]) -> Stage:
    """The stage that a run's resolved scenario describes.

    Raises:
        ScenarioError: it cannot be built any more.
        ValueError: it has other vehicles than the recording.
    """
    scenario, source = scenarios.load(path)
    if tuple(each.name for each in scenario.vehicle) != tuple(vehicles):
        raise ValueError(f"{path} is of another run than the recording beside it")
    world, _ = worlds.build(scenario.world, source, seed=scenario.seed)
    return Stage(scenery_of(scenario, source, world=world, may=MAY), world)


def bare_stage(about: Mapping[str, str], vehicles: Sequence[str], drawing: bytes | None) -> Stage:
    """The vehicles alone, as big as they are drawn in the recording.

    Args:
        about: what the recording says of its run.
        vehicles: in their order.
        drawing: the message that draws them, if there is one.

    Raises:
        ValueError: it is no such message.
    """
    radius_m, seed = {} if drawing is None else _radii(drawing), about.get("seed", "")
    scenery = Scenery(
        scenario=about.get("scenario", ""),
        seed=int(seed) if seed.isdecimal() else 0,
        duration_ns=0,
        vehicles=tuple(_craft(name, radius_m.get(name, DEFAULT_RADIUS_M)) for name in vehicles),
        vertices=frozen(np.zeros((0, 3)), np.float32),
        triangles=frozen(np.zeros((0, 3)), np.uint32),
        colors=frozen(np.zeros((0, 3)), np.uint8),
        may=MAY,
    )
    return Stage(scenery)


class _Size(msgspec.Struct):
    x: float


class _Cylinder(msgspec.Struct):
    size: _Size


class _Entity(msgspec.Struct):
    id: str
    cylinders: tuple[_Cylinder, ...] = ()


class _Drawing(msgspec.Struct):
    """What is needed of a `SceneUpdate`."""

    entities: tuple[_Entity, ...]


def _radii(drawing: bytes) -> dict[str, float]:
    entities = msgspec.json.decode(drawing, type=_Drawing).entities
    return {each.id: 0.5 * each.cylinders[0].size.x for each in entities if each.cylinders}


def _craft(name: str, radius_m: float) -> Craft:
    return Craft(name=name, kind="", size=(2.0 * radius_m, 2.0 * radius_m, radius_m))
