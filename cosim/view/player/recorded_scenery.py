"""What stood around the vehicles of a recorded run, as far as its folder can tell."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from vcmvsp.cosim.assembly import recorded_world
from vcmvsp.cosim.config.user_classes import NO_CODE, only
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.types import frozen
from vcmvsp.cosim.util.documents import read_json
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


def stage_of(path: Path, vehicles: Sequence[str], drawing: bytes | None, *, trust: bool = False) -> Stage:
    """The stage that a run's resolved scenario describes; what is not built in, as the recording draws it.

    Args:
        path: of the scenario.
        vehicles: in their order.
        drawing: the message that draws them, if there is one.
        trust: import classes that are not built in.

    Raises:
        ScenarioError, UsageError: it cannot be built any more.
        ValueError: it has other vehicles than the recording.
    """
    scenario, source = scenarios.load(path)
    if tuple(each.name for each in scenario.vehicle) != tuple(vehicles):
        raise ValueError(f"{path} is of another run than the recording beside it")
    with only(None if trust else NO_CODE):
        world = recorded_world.world_in(path.parent, scenario, source)
        return Stage(scenery_of(scenario, source, world=world, may=MAY, drawn=_drawn(vehicles, drawing)), world)


def bare_stage(about: Mapping[str, str], vehicles: Sequence[str], drawing: bytes | None) -> Stage:
    """The vehicles alone, as big as they are drawn in the recording.

    Args:
        about: what the recording says of its run.
        vehicles: in their order.
        drawing: the message that draws them, if there is one.

    Raises:
        ValueError: it is no such message.
    """
    seed = about.get("seed", "")
    scenery = Scenery(
        scenario=about.get("scenario", ""),
        seed=int(seed) if seed.isdecimal() else 0,
        duration_ns=0,
        vehicles=tuple(_drawn(vehicles, drawing).values()),
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


def _drawn(vehicles: Sequence[str], drawing: bytes | None) -> dict[str, Craft]:
    """Vehicles as big as they are drawn."""
    shown: _Drawing = _Drawing(()) if drawing is None else read_json(drawing, _Drawing)
    width_m = {each.id: each.cylinders[0].size.x for each in shown.entities if each.cylinders}
    sizes = {name: width_m.get(name, 2.0 * DEFAULT_RADIUS_M) for name in vehicles}
    return {name: Craft(name=name, kind="", size=(size, size, 0.5 * size)) for name, size in sizes.items()}
