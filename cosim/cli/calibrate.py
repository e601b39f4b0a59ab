"""``vcmvsp calibrate``: from a measured log to the keys of ``[radio]``."""

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import UsageError


def calibrate_command(
    links: Annotated[
        Path, typer.Argument(metavar="LINKS.csv", help="Columns time,ax,ay,az,bx,by,bz,rssi_dbm[,received], in s, m, dBm.")
    ],
    tx_power: Annotated[float, typer.Option(metavar="DBM", help="What was sent, antenna gains included.")] = 0.0,
    reference_distance: Annotated[float, typer.Option(metavar="M", help="Where the level is stated.")] = 1.0,
    sensitivity: Annotated[
        float | None, typer.Option(metavar="DBM", help="Weaker frames are lost [the least level that was received].")
    ] = None,
    world: Annotated[
        str | None, typer.Option(metavar="SCENARIO", help="Whose walls stood there: the loss of each material is fitted.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for radio.toml and calibration.png.")] = None,
    json: AsJson = False,
) -> None:
    """Fit path loss, shadowing, walls and fading to a measured log; with standard errors.

    Example: vcmvsp calibrate links.csv --tx-power 16 --sensitivity -90 --world lab.toml --out lab-radio
    """
    import msgspec

    from vcmvsp.cosim.config import registry
    from vcmvsp.cosim.util.files import to_json

    for option, value in (
        ("--tx-power", tx_power),
        ("--sensitivity", sensitivity),
        ("--reference-distance", reference_distance),
    ):
        if value is not None and not math.isfinite(value):
            raise UsageError(f"{option} {value}: must be a finite number")
    if out is not None and out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: there is a file of that name; name a folder")
    fitting = registry.piece("calibration")
    sightline = None if world is None else _sightline(world)
    log, calibration = fitting.calibrate_file(
        links,
        tx_power_dbm=tx_power,
        reference_distance_m=reference_distance,
        sensitivity_dbm=sensitivity,
        sightline=sightline,
    )
    if out is not None:
        write_calibration(out, calibration, fitting.figure_data(log, calibration, sightline))
    if json:
        sys.stdout.write(to_json({**msgspec.to_builtins(calibration), "radio": calibration.table()}))
        return
    sys.stdout.write(f"{calibration.summary()}\n\n{calibration.toml()}")
    for name in ("radio.toml", "calibration.png") if out is not None else ():
        sys.stdout.write(f"{Path(out or '') / name}\n")


def write_calibration(folder: Path, calibration: Any, figure_data: Any) -> None:
    """Write ``radio.toml`` and ``calibration.png``: a calibration of `netsim.calibration`, and the data of its figure."""
    from vcmvsp.cosim.plots.calibration_plot import draw_calibration
    from vcmvsp.cosim.plots.files import save_png

    folder.mkdir(parents=True, exist_ok=True)
    (folder / "radio.toml").write_text(calibration.toml(), "utf-8")
    save_png(draw_calibration(**figure_data._asdict()), folder / "calibration.png")


def _sightline(world: str) -> Any:
    """What stands in the world of a scenario."""
    from vcmvsp.cosim.assembly import worlds
    from vcmvsp.cosim.config import registry
    from vcmvsp.cosim.scenario import loader

    parsed, source = loader.load(world)
    built, _ = worlds.build(parsed.world, source, seed=parsed.seed)
    return registry.piece("sightline")(built.solids)
