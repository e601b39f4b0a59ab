"""Radio coverage map of a vehicle in a scenario, computed by the channel of a run at a grid of positions."""

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from vcmvsp.cosim.assembly import radio, worlds
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.builtin_kinds import KINDS
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.config.registry import NO_CODE, only
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.metrics.motion import Motion, motion
from vcmvsp.cosim.recording.recorded_run import tables_of
from vcmvsp.cosim.scenario import loader as scenario
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.types import Array, Vec3
from vcmvsp.cosim.util.files import write_whole

if TYPE_CHECKING:
    from vcmvsp.cosim.assembly.parts.radio import Channel

SCHEMA = "vcmvsp.coverage/1"
MOST_PLACES = 1_000_000
_STEPS = 150  # approximate grid points along the longer side


class Site(msgspec.Struct, frozen=True):
    """The radio environment of a scenario: channel, solids and antenna positions."""

    channel: "Channel"
    solids: Sequence[Any]  # of the world
    places: Mapping[str, Vec3]  # of the vehicles, m, world
    not_executed: tuple[str, ...] = ()  # tables of the scenario whose classes were not imported


class Map(msgspec.Struct, frozen=True, kw_only=True):
    """Level and success probability on a grid of positions seen from above."""

    scenario: str
    vehicle: str
    preset: str
    seed: int
    size_bytes: int
    height_m: float  # of the receivers' antennas
    floor_dbm: float  # detection floor: the weakest level that a receiver detects
    noise_dbm: float
    x: Array  # (m,) m, world
    y: Array  # (n,)
    level_dbm: Array  # (n, m) mean over the fading
    success: Array  # (n, m) probability that a frame arrives
    places: Mapping[str, Vec3]  # of the vehicles
    others: Mapping[str, tuple[float, float]]  # level and success at each other vehicle's own antenna
    solids: Sequence[Any]  # of the world
    not_executed: tuple[str, ...] = ()  # tables of the scenario whose classes were not imported


def _site(folder: Path | None, parsed: Scenario, source: Source) -> Site:
    """Radio environment of a scenario or of a recorded run, restricted to importable classes (`registry.may_import`).

    Layers that may not be imported are replaced by the preset's, such a world by the solids in the recording.
    """
    parsed = parsed.with_radio(next(iter(parsed.radios))) if parsed.radios else parsed
    importable, own = (parsed, ()) if folder is None else without_own_layers(parsed)
    if folder is None:
        world, _ = worlds.build(parsed.world, source, seed=parsed.seed)
    else:
        from vcmvsp.cosim.assembly.recorded_world import world_in

        world = world_in(folder, parsed, source)
        if not registry.may_import("world", parsed.world.get("kind", "empty")):
            own = (*own, "world")
    channel, _, _ = radio.channel_of(importable, source, solids=world.solids)
    return Site(channel, world.solids, {each.name: each.start[0] for each in parsed.vehicle}, own)


def without_own_layers(parsed: Scenario) -> tuple[Scenario, tuple[str, ...]]:
    """A scenario without radio layers whose classes may not be imported, and the names of the removed layers."""
    kinds = {
        name: table["kind"] for name, table in parsed.first_radio.items() if isinstance(table, Mapping) and "kind" in table
    }
    own = tuple(f"radio.{name}" for name, kind in kinds.items() if name in KINDS and not registry.may_import(name, kind))
    layers = {name: value for name, value in parsed.first_radio.items() if f"radio.{name}" not in own}
    return msgspec.structs.replace(parsed, radio=layers), own


def coverage(
    what: str | Path | Mapping[str, Any],
    vehicle: str,
    *,
    at_s: float | None = None,
    size_bytes: int = 100,
    height_m: float = 0.5,
    resolution_m: float | None = None,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    trust: bool = False,
) -> Map:
    """Compute the coverage map of a vehicle's transmitter.

    Args:
        what: a scenario, or the directory of a run.
        vehicle: the sender.
        at_s: for a run: time at which the vehicles' positions are taken; default: the start.
        size_bytes: payload of a frame.
        height_m: height of the receivers' antennas above the floor.
        resolution_m: grid spacing; default: about 150 positions along the longer side.
        seed: replaces the scenario's seed.
        set: key path -> value, as for a run.
        trust: for a run: import classes of its scenario that are not built in.

    Raises:
        ScenarioError: the radio of the scenario is invalid.
        UsageError: unknown vehicle, invalid time or resolution, or unreadable states of the run.
    """
    if resolution_m is not None and not (math.isfinite(resolution_m) and resolution_m > 0.0):
        raise UsageError(f"a resolution of {resolution_m:g} m: must be a positive number")
    folder = _run_folder(what)
    parsed, _, site = site_of(what, settings=set, seed=seed, trust=trust)
    if vehicle not in site.places:
        raise UsageError(binding.unknown("vehicle", vehicle, site.places))
    if at_s is not None:
        if folder is None:
            raise UsageError("a time needs a recorded run: name the folder of a run, or leave it out")
        site = msgspec.structs.replace(site, places=places_at(folder, at_s * SECOND_NS))
    return _map(site, parsed, vehicle, size_bytes, height_m, resolution_m)


def site_of(
    what: str | Path | Mapping[str, Any], *, settings: Mapping[str, Any] | None, seed: int | None, trust: bool
) -> tuple[Scenario, Source, Site]:
    """The scenario, and its radio environment, of a scenario or of the directory of a run."""
    folder = _run_folder(what)
    parsed, source = scenario.load(folder / "scenario.toml" if folder else what, settings=settings, seed=seed)
    with only(None if trust or folder is None else NO_CODE):
        return parsed, source, _site(folder, parsed, source)


def _run_folder(what: str | Path | Mapping[str, Any]) -> Path | None:
    folder = Path(what) if isinstance(what, str | Path) and Path(what).is_dir() else None
    if folder is not None and not (folder / "scenario.toml").is_file():
        raise UsageError(f"{folder}: no scenario.toml here; name a scenario, or the folder of a run")
    return folder


def _map(site: Site, parsed: Scenario, vehicle: str, size_bytes: int, height_m: float, resolution_m: float | None) -> Map:
    from vcmvsp.cosim.assembly.parts.channel_trial import coverage as measured

    x, y = _grid(site, partial(measured.range_m, site.channel, vehicle, height_m), vehicle, resolution_m)
    antennas = np.stack([*(axis.ravel() for axis in np.meshgrid(x, y)), np.full(len(x) * len(y), height_m)], axis=-1)
    position = np.array(site.places[vehicle])
    on_grid = measured.coverage(site.channel, vehicle, position, antennas, size_bytes=size_bytes, seed=parsed.seed)
    at_vehicles = measured.among(site.channel, vehicle, site.places, size_bytes=size_bytes, seed=parsed.seed)
    others = [name for name in site.places if name != vehicle]
    shape = len(y), len(x)
    return Map(
        scenario=parsed.name,
        vehicle=vehicle,
        preset=parsed.first_radio.get("preset", "ideal"),
        seed=parsed.seed,
        size_bytes=size_bytes,
        height_m=height_m,
        floor_dbm=measured.floor_dbm(site.channel),
        noise_dbm=site.channel.hearing.noise_dbm,
        x=x,
        y=y,
        level_dbm=on_grid.level_dbm.reshape(shape),
        success=on_grid.success.reshape(shape),
        places=site.places,
        others=dict(zip(others, zip(at_vehicles.level_dbm.tolist(), at_vehicles.success.tolist(), strict=True), strict=True)),
        solids=site.solids,
        not_executed=site.not_executed,
    )


def _grid(site: Site, range_of: Callable[[], float | None], vehicle: str, resolution_m: float | None) -> tuple[Array, Array]:
    points = np.array([place[:2] for place in site.places.values()])
    corners = [corner for solid in site.solids for piece in solid.uprights() for corner in piece.corners]
    if corners:
        points = np.concatenate([points, corners])
    low, high = points.min(axis=0), points.max(axis=0)
    margin = max(2.0, 0.1 * float((high - low).max()))
    range_m = None if corners else range_of()
    if range_m is not None:
        centre = np.array(site.places[vehicle][:2])
        low, high, margin = np.minimum(low, centre - range_m), np.maximum(high, centre + range_m), 0.1 * range_m
    low, high = low - margin, high + margin
    step = resolution_m or _round_step(float((high - low).max()) / _STEPS)
    first = np.floor(low / step)
    count = np.ceil(high / step) - first + 1.0
    if not count.prod() <= MOST_PLACES:
        columns, rows = (f"{each:.0f}" for each in count)
        raise UsageError(f"a step of {step:g} m gives {columns} x {rows} places; use a larger one (at most {MOST_PLACES})")
    x, y = (step * (first[axis] + np.arange(count[axis])) for axis in (0, 1))
    return x, y


def _round_step(step_m: float) -> float:
    power = 10.0 ** math.floor(math.log10(step_m))
    return next(power * digit for digit in (1.0, 2.0, 5.0, 10.0) if power * digit >= step_m * (1.0 - 1e-9))


def _motion_of(folder: Path) -> Motion:
    try:
        return motion(tables_of(folder, radio=()).states)
    except (OSError, ValueError) as error:  # a damaged table
        raise UsageError(f"{folder} cannot be read: {error}") from error


def places_at(folder: Path, at_ns: float) -> dict[str, Vec3]:
    """The vehicles' positions in a run at a time, m, world."""
    moved = _motion_of(folder)
    instant = int(np.searchsorted(moved.time_ns, at_ns, side="right")) - 1
    if instant < 0 or not at_ns <= moved.time_ns[-1]:
        raise UsageError(f"{at_ns / SECOND_NS:g} s: the run in {folder} lasted from 0 to {moved.time_ns[-1] / SECOND_NS:g} s")
    return {name: tuple(moved.position[:, instant, moved.column(name)].tolist()) for name in moved.names}


def write_antennas(folder: Path, target: Path) -> int:
    """Write the antennas' recorded places of a run as CSV, ``t,name,x,y,z`` (s, m); returns the number of lines."""
    parsed, source = scenario.load(folder / "scenario.toml")
    channel, _, _ = radio.channel_of(without_own_layers(parsed)[0], source, solids=())
    moved = _motion_of(folder)
    above = channel.budgets.antennas_above(moved.names)
    lines = ["t,name,x,y,z"]
    for row, time_ns in enumerate(moved.time_ns.tolist()):
        places = moved.position[:, row].T + above
        for name, place in zip(moved.names, places.tolist(), strict=True):
            if not math.isnan(place[0]):
                lines.append(",".join([repr(time_ns / SECOND_NS), name, *map(repr, place)]))
    try:
        write_whole(target, "\n".join([*lines, ""]).encode("utf-8"))
    except OSError as error:
        raise UsageError(f"--positions {target}: {error.strerror or error}") from error
    return len(lines) - 1


def to_table(coverage_map: Map) -> dict[str, Any]:
    """The map for JSON: rows from south to north, each from west to east."""
    names = ("scenario", "vehicle", "preset", "seed", "size_bytes", "height_m", "floor_dbm", "noise_dbm")
    table: dict[str, Any] = {"schema": SCHEMA, **{name: getattr(coverage_map, name) for name in names}}
    table["vehicles"] = {name: list(place) for name, place in coverage_map.places.items()}
    others = coverage_map.others.items()
    table["at_vehicles"] = {name: {"level_dbm": level, "success": success} for name, (level, success) in others}
    if coverage_map.not_executed:
        table["not_executed"] = list(coverage_map.not_executed)
    return table | {
        "heard_share": covered_share(coverage_map),
        "mean_success": float(coverage_map.success.mean()),
        "x_m": coverage_map.x.tolist(),
        "y_m": coverage_map.y.tolist(),
        "level_dbm": coverage_map.level_dbm.tolist(),
        "success": coverage_map.success.tolist(),
    }


def covered_share(coverage_map: Map) -> float:
    """Share of the area with a mean level at or above the detection floor."""
    return float((coverage_map.level_dbm >= coverage_map.floor_dbm).mean())


def summary(coverage_map: Map) -> str:
    """The map as a few lines of text."""
    width, height = (float(np.ptp(axis)) for axis in (coverage_map.x, coverage_map.y))
    lines = [
        f"{coverage_map.scenario}: the level of {coverage_map.vehicle} is {coverage_map.floor_dbm:.1f} dBm or more in "
        f"{100.0 * covered_share(coverage_map):.1f} % of {width:g} x {height:g} m; "
        f"{100.0 * coverage_map.success.mean():.1f} % of its frames of {coverage_map.size_bytes} bytes arrive, "
        "averaged over all places, without random loss (radio.loss) and collisions"
    ]
    lines += [
        f"  {name}: {level:.1f} dBm, {100.0 * success:.1f} % arrive" for name, (level, success) in coverage_map.others.items()
    ]
    if coverage_map.not_executed:
        own = ", ".join(coverage_map.not_executed)
        lines.append(
            f"  not executed: the classes of {own}; used instead: the preset's layers, and the recorded world in concrete"
        )
    return "\n".join(lines) + "\n"
