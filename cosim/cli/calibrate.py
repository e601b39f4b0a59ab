"""``vcmvsp calibrate`` and ``calibrate-recognition``: parameters of models, from measurements.

The first fits ``[radio]`` to a measured log, the second measures how far the map of a search may trust its camera.
"""

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import Interrupted, UsageError
from vcmvsp.cosim.terminal.progress import StatusDisplay
from vcmvsp.cosim.util.files import to_json, write_whole, writing
from vcmvsp.cosim.util.text import stdout_to_stderr

if TYPE_CHECKING:
    from vcmvsp.cosim.analysis.snapshots import Rates, Share, Snapshots
    from vcmvsp.cosim.assembly.parts.calibration import Calibration, FigureData


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

    from vcmvsp.cosim.assembly.parts.calibration import calibrate_file, figure_data, sightline_of

    for option, value in (
        ("--tx-power", tx_power),
        ("--sensitivity", sensitivity),
        ("--reference-distance", reference_distance),
    ):
        if value is not None and not math.isfinite(value):
            raise UsageError(f"{option} {value}: must be a finite number")
    if out is not None and out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: there is a file of that name; name a folder")
    sightline = None if world is None else sightline_of(world)
    log, calibration = calibrate_file(
        links, tx_power_dbm=tx_power, reference_distance_m=reference_distance, sensitivity_dbm=sensitivity, sightline=sightline
    )
    if out is not None:
        write_calibration(out, calibration, figure_data(log, calibration, sightline))
    if json:
        sys.stdout.write(to_json({**msgspec.to_builtins(calibration), "radio": calibration.table()}))
        return
    sys.stdout.write(f"{calibration.summary()}\n\n{calibration.toml()}")
    for name in ("radio.toml", "calibration.png") if out is not None else ():
        sys.stdout.write(f"{Path(out or '') / name}\n")


def write_calibration(folder: Path, calibration: "Calibration", figure_data: "FigureData") -> None:
    """Write ``radio.toml`` and ``calibration.png``: a calibration of `netsim.calibration`, and the data of its figure."""
    from vcmvsp.cosim.plots.radio_plots import draw_calibration
    from vcmvsp.cosim.plots.style import save_png

    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "radio.toml", calibration.toml())
        save_png(draw_calibration(**figure_data._asdict()), folder / "calibration.png")


def calibrate_recognition_command(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A built-in scenario, or a file.")],
    vehicle: Annotated[
        str | None, typer.Option(metavar="NAME", help="Whose camera [the first that looks for targets].")
    ] = None,
    height: Annotated[float | None, typer.Option(metavar="M", help="Of the vehicle [at which it searches].")] = None,
    frames: Annotated[int, typer.Option(metavar="N", help="How many pictures; every other one shows a target.")] = 200,
    cell: Annotated[float | None, typer.Option(metavar="M", help="Side of a cell of the map [that of its search].")] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Of the places; that of the world is the scenario's.")] = 0,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a key, e.g. world.seed=3.")
    ] = None,
    json: AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Measure p and q of a search: how often a look at a cell of the map is right, with and without a target in it.

    Takes pictures at random places over the scenario's own world, with its own camera and targets, and runs the detector.
    Ends with the two lines for the scenario.

    Example: vcmvsp calibrate-recognition recon-urban --frames 400
    """
    from vcmvsp.cosim.analysis.snapshots import Rates, Snapshots
    from vcmvsp.cosim.scenario import loader as scenarios

    for option, value in (("--height", height), ("--cell", cell)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise UsageError(f"{option} {value}: must be a number greater than 0")
    if frames < 1:
        raise UsageError(f"--frames {frames}: must be 1 or more")
    if seed < 0:
        raise UsageError(f"--seed {seed}: must be 0 or more")
    rates = Rates()
    try:
        with stdout_to_stderr(), _Pictures(quiet=quiet) as progress:
            settings = scenarios.settings_of(set_ or [])
            taken = Snapshots(scenario, vehicle=vehicle, height_m=height, cell_m=cell, seed=seed, settings=settings)
            for number in range(frames):
                rates.add(taken.take(number, frames))
                progress.on_picture(number + 1, frames)
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
    about = {
        "scenario": scenario,
        "vehicle": taken.vehicle,
        "height_m": taken.height_m,
        "cell_m": taken.cell_m,
        "frames": frames,
    }
    sys.stdout.write(to_json({**about, **rates.plain()}) if json else _text(about, rates, taken))


class _Pictures(StatusDisplay):
    def on_picture(self, done: int, of: int) -> None:
        """Tell how many pictures are taken."""
        if self._is_due():
            words = f"{done} of {of} pictures"
            self._draw(done, of, words) if self._terminal else self.tell(words)


def _text(about: dict[str, Any], rates: "Rates", taken: "Snapshots") -> str:
    lines = [
        f"{about['vehicle']} of {about['scenario']}: {about['frames']} pictures from {about['height_m']:g} m, "
        f"cells of {about['cell_m']:g} m",
        "",
    ]
    named: dict[str, Share] = {
        "p, looks at cells with a target that say so": rates.p,
        "q, looks at cells without one that say target": rates.q,
        "precision": rates.precision,
        "recall": rates.recall,
        "recall, unoccluded": rates.unoccluded,
        **{f"recall, unoccluded, {ring} of the picture": each for ring, each in rates.by_ring.items()},
    }
    width = max(map(len, named))
    lines += [f"{name:<{width}}  {_words(each)}" for name, each in named.items()]
    lines += ["", f"[{taken.table}]", f"p = {_number(rates.p.mean)}", f"q = {_number(rates.q.mean)}", ""]
    if rates.p.mean <= rates.q.mean:
        lines += ["# p must be greater than q: the map learns nothing from these looks", ""]
    return "\n".join(lines)


def _words(share: "Share") -> str:
    low, high = share.interval
    value = "-" if not share.of else f"{share.value:.3g}"
    return f"{value:>8}  {low:.3g} to {high:.3g} (95 %), {share.part} of {share.of}"


def _number(value: float) -> str:
    """With two digits that count, of what is left to 1 too."""
    digits = 1 - math.floor(math.log10(min(value, 1.0 - value)))
    return f"{value:.{digits}f}"
