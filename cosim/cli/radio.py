"""``vcmvsp radio``: why messages of a run arrived or not, and where a vehicle of a scenario is heard."""

import math
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import UsageError


def radio_command(
    what: Annotated[
        str, typer.Argument(metavar="RUN_DIR|SCENARIO", help="A folder that 'vcmvsp run' has left; or a scenario.")
    ],
    link: Annotated[
        str | None, typer.Option(metavar="A/B", help="Links from A to B, e.g. car1/car2, or 'car1/*' for all that car1 sends.")
    ] = None,
    frame: Annotated[
        str | None, typer.Option(metavar="N", help="The link budget of frame N; of the first one 'lost'; of the 'worst'.")
    ] = None,
    coverage: Annotated[str | None, typer.Option(metavar="VEHICLE", help="Draw a map of where this vehicle is heard.")] = None,
    at: Annotated[float | None, typer.Option(metavar="S", help="Map: of a run, when [at its start].")] = None,
    size: Annotated[int | None, typer.Option(metavar="BYTES", min=0, help="Map: payload of the frames [100].")] = None,
    height: Annotated[float | None, typer.Option(metavar="M", help="Map: of the receivers' antennas [0.5].")] = None,
    resolution: Annotated[
        float | None, typer.Option(metavar="M", help="Map: from place to place [about 150 along the longer side].")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Map: where to put it [coverage-VEHICLE.png].")] = None,
    seed: Annotated[int | None, typer.Option(help="Map: instead of the scenario's.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Map: change a key of the scenario.")
    ] = None,
    json: AsJson = False,
) -> None:
    """Explain the radio: delivery, losses and link budgets of a run; coverage of a scenario.

    Examples: vcmvsp radio runs/formation-circle-1 --link car1/car2 --frame worst;
    vcmvsp radio formation-circle --coverage car1 --out map.png
    """
    of_map: dict[str, Any] = {
        "at": at,
        "size": size,
        "height": height,
        "resolution": resolution,
        "out": out,
        "seed": seed,
        "set": set_ or None,
    }
    given = {name: value for name, value in of_map.items() if value is not None}
    if coverage is None:
        if given:
            raise UsageError(f"--{next(iter(given))} goes with --coverage VEHICLE")
        answer, text = _explained(Path(what), link, frame)
    else:
        if link is not None or frame is not None:
            raise UsageError("--coverage draws a map; --link and --frame ask about a run: give one or the other")
        for name, value in given.items():
            if isinstance(value, float) and not (math.isfinite(value) and (name != "resolution" or value > 0.0)):
                raise UsageError(f"--{name} {value}: must be a {'positive' if name == 'resolution' else 'finite'} number")
        answer, text = _drawn(what, coverage, given, json=json)
    if json:
        from vcmvsp.cosim.util.files import to_json

        sys.stdout.write(to_json(_plain(answer)))
    else:
        sys.stdout.write(text)


def _plain(value: Any) -> Any:
    """The value with None for numbers that JSON cannot say: a vehicle may have been sent to infinity."""
    if isinstance(value, dict):
        return {name: _plain(each) for name, each in value.items()}
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _explained(folder: Path, link: str | None, frame: str | None) -> tuple[dict[str, Any], str]:
    from vcmvsp.cosim.analysis import link_text, links

    log = links.Log(folder)
    head = {"schema": links.SCHEMA, "scenario": log.facts.scenario, "seed": log.facts.seed}
    pairs = log.pairs(link or "*/*")
    single = link is not None and not set("*?[") & set(link)
    if frame is not None:
        from vcmvsp.cosim.analysis.link_budget import frame_report

        if not single:
            raise UsageError(f"--frame {frame} needs one link: give --link SENDER/RECEIVER")
        report = frame_report(log, pairs[0], frame)
        return {**head, "frame": report}, link_text.frame_text(report)
    if single:
        found = links.link_report(log, pairs[0])
        return {**head, "links": [found]}, link_text.link_text(found)
    rows = links.overview(log, link or "*/*")
    text = link_text.overview_text(rows, log.vehicles)
    if link is not None:
        rows = [links.link_report(log, (row["sender"], row["receiver"])) for row in rows]
    return {**head, "links": rows}, text


def _drawn(what: str, vehicle: str, given: dict[str, Any], *, json: bool) -> tuple[dict[str, Any], str]:
    from vcmvsp.cosim.analysis import coverage as maps
    from vcmvsp.cosim.scenario import loader

    names = {"at": "at_s", "size": "size_bytes", "height": "height_m", "resolution": "resolution_m", "seed": "seed"}
    settings = loader.settings_of(given.get("set", []))
    found = maps.coverage(what, vehicle, set=settings, **{names[name]: given[name] for name in given if name in names})
    answer = maps.to_table(found)
    out = given.get("out")
    if json and out is None:
        return answer, ""
    out = out or Path(f"coverage-{vehicle}.png")
    from vcmvsp.cosim.plots import coverage_plot, files

    try:
        files.save_png(coverage_plot.coverage(found), out)
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror or error}") from error
    return {**answer, "file": str(out)}, maps.summary(found) + f"map: {out}\n"
