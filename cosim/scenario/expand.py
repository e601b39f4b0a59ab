"""One ``[[vehicle]]`` for many: ``count`` vehicles of the same kind, in rows.

::

    [[vehicle]]
    name = "uav"               # uav1, uav2, ... uav100
    count = 100
    columns = 10               # in each row
    spacing = [10.0, 10.0]     # m: between columns (x), between rows (y)
    position = [-45.0, -45.0, 5.0]    # of the first
"""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec

from vcmvsp.cosim.config import binding
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Vec3

MOST = 10_000  # vehicles of a scenario: what they need grows with them, and with their pairs
_PLACES = {"pose": Vec3, "position": Vec3}


class Repeat(msgspec.Struct, frozen=True, kw_only=True):
    """How a vehicle is repeated."""

    count: Annotated[int, msgspec.Meta(ge=1, le=MOST)]  # how many there are; their names get numbers, from 1 on
    columns: Annotated[int, msgspec.Meta(ge=1)] | None = None  # in each row; None: all in one
    spacing: tuple[float, float] = (1.0, 1.0)  # m, between columns (along x) and between rows (along y)


KEYS = tuple(binding.parameters(Repeat))


def repeated(listed: Sequence[Any], source: Source) -> list[Any]:
    """The vehicles, each that has a ``count`` as often as it says."""
    counts = [one.get("count", 1) if isinstance(one, dict) else 1 for one in listed]
    if (total := sum(each for each in counts if isinstance(each, int))) > MOST:
        problem = f"there may be {MOST} vehicles in all, not {total}: give fewer, or a smaller count"
        raise ScenarioError(problem, key="vehicle", source=source.of("vehicle"))
    return [each for one in listed for each in (_copies(one, source) if isinstance(one, dict) else [one])]


def names_copy(raw: Mapping[str, Any], key: str) -> bool:
    """Whether a key path is of one copy of a repeated vehicle: ``vehicle.uav7.kind``."""
    group, _, rest = key.partition(".")
    name, listed = rest.partition(".")[0], raw.get("vehicle")
    stems = (
        [str(each.get("name")) for each in listed if isinstance(each, dict) and "count" in each]
        if isinstance(listed, list)
        else []
    )
    return group == "vehicle" and any(name.startswith(stem) and name[len(stem) :].isdigit() for stem in stems)


def _copies(one: dict[str, Any], source: Source) -> list[dict[str, Any]]:
    key = f"vehicle.{one.get('name', '')}"
    said = {name: one[name] for name in KEYS if name in one}
    if not said:
        return [one]
    if "count" not in said:
        where = f"{key}.{next(iter(said))}"
        raise ScenarioError("means nothing without a count", key=where, source=source.of(where))
    repeat = binding.call(Repeat, said, key=key, origin=source)
    rest = {name: value for name, value in one.items() if name not in KEYS}
    place = next((name for name in _PLACES if name in rest), "position")
    x, y, last = binding.convert(rest.get(place, (0.0, 0.0, 0.0)), Vec3, key=f"{key}.{place}", origin=source)
    columns, (dx, dy) = repeat.columns or repeat.count, repeat.spacing
    return [
        {**rest, "name": f"{one.get('name', '')}{i + 1}", place: [x + i % columns * dx, y + i // columns * dy, last]}
        for i in range(repeat.count)
    ]
