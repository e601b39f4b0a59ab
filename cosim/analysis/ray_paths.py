"""Paths of the radio wave between given points in the world of a scenario, computed by the rays of a run's channel."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vcmvsp.cosim.analysis.coverage import places_at, site_of
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.tables.schema import write_table
from vcmvsp.cosim.util.files import replacing

if TYPE_CHECKING:
    import pyarrow as pa


def ray_paths(
    what: str | Path | Mapping[str, Any],
    points: Path,
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    trust: bool = False,
) -> "pa.Table":
    """All paths between points, a row a path.

    Args:
        what: a scenario with ``path_loss = { kind = "rays" }``, or the directory of its run.
        points: CSV file with a line x,y,z (m, world) for each point.
        seed: replaces the scenario's seed, on which a random world depends.
        set: key path -> value, as for a run.
        trust: for a run: import classes of its scenario that are not built in.

    Raises:
        ScenarioError: the radio of the scenario is invalid, or has no rays.
        UsageError: an invalid file, or a point inside a solid.
    """
    from vcmvsp.cosim.assembly.parts import channel_trial

    places = channel_trial.read_positions(points).at(0)
    parsed, source, site = site_of(what, settings=set, seed=seed, trust=trust)
    try:
        return channel_trial.ray_paths(site.channel, places)
    except ScenarioError as error:
        raise ScenarioError(error.problem, key=error.key, source=source.of(error.key)) from error
    except UsageError as error:
        raise UsageError(f"{points}: {error}; scenario {parsed.name}") from error


def of_frame(folder: Path, pair: tuple[str, str], sent_ns: int, *, trust: bool = False) -> list[dict[str, Any]]:
    """The paths of a frame of a run, by gain: ``kinds``, ``gain_db``, ``delay_ns``, ``points``; none if its radio has no rays.

    They lie between the antennas at the newest recorded positions.
    """
    from vcmvsp.cosim.assembly.parts import channel_trial

    radio = loader.load(folder / "scenario.toml")[0].radio
    table = radio.get("path_loss") if isinstance(radio, Mapping) else None
    if not isinstance(table, Mapping) or table.get("kind") != "rays":
        return []
    _, _, site = site_of(folder, settings=None, seed=None, trust=trust)
    places = {**site.places, **places_at(folder, sent_ns)}
    antennas = np.array([places[name] for name in pair]) + site.channel.budgets.antennas_above(pair)
    rows = channel_trial.ray_paths(site.channel, antennas).drop_columns(["a", "b", "phase_rad"]).to_pylist()
    return sorted(rows, key=lambda row: -row["gain_db"])


def save(table: "pa.Table", path: Path) -> None:
    """Write the table as Parquet; equal tables give equal bytes."""
    try:
        with replacing(path) as place:
            write_table(table, place)
    except OSError as error:
        raise UsageError(f"--out {path}: {error.strerror or error}") from error


def summary(table: "pa.Table", path: Path) -> str:
    """The number of paths by kind, as text."""
    kinds = Counter(str(kind) for kind in table.column("kinds").to_pylist())
    pairs = len(set(zip(table.column("a").to_pylist(), table.column("b").to_pylist(), strict=True)))
    lines = [f"{table.num_rows} paths between {pairs} pairs of points: {path}"]
    lines += [f"  {count:6d}  {kind}" for kind, count in sorted(kinds.items(), key=lambda item: (-item[1], item[0]))]
    return "\n".join(lines) + "\n"
