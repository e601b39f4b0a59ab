"""``vcmvsp radio``, ``channel``, ``per``, ``pathloss``, ``calibrate``: the radio of a run or scenario, or the channel alone."""

import contextlib
import json as jsons
import math
import sys
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson, Changes, Quiet, Trust, changes, say
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.terminal.progress import StatusDisplay
from vcmvsp.cosim.util.files import finite, to_json, write_whole, writing
from vcmvsp.cosim.util.text import aligned, stdout_to_stderr

if TYPE_CHECKING:
    from vcmvsp.cosim.analysis.snapshots import Rates, Share, Snapshots
    from vcmvsp.cosim.assembly.parts.calibration import Calibration, RayCalibration
    from vcmvsp.cosim.assembly.parts.channel_trial import Channel, RowFile, TrialTraffic
    from vcmvsp.cosim.config.provenance import Source


Preset = Annotated[str, typer.Option(metavar="NAME", help="A preset of the radio, e.g. ideal, wss, wifi-b-1, zigbee.")]
OfLayer = Annotated[Changes, changes("Change a key of a layer, e.g. path_loss.exponent=2.5.")]
Size = Annotated[int, typer.Option(metavar="BYTES", help="Payload of a frame; the standard's headers are added.")]


def radio_command(
    what: Annotated[str, typer.Argument(metavar="RUN_DIR|SCENARIO", help="Folder of a run, or a scenario.")],
    link: Annotated[
        str | None, typer.Option(metavar="A/B", help="Links from A to B, e.g. car1/car2, or 'car1/*' for all that car1 sends.")
    ] = None,
    frame: Annotated[
        str | None, typer.Option(metavar="N", help="Link budget of frame N, of the first 'lost' or of the 'worst' frame.")
    ] = None,
    paths: Annotated[
        Path | None, typer.Option(metavar="POINTS.csv", help="Write all paths of rays between points, x,y,z (m) a line.")
    ] = None,
    positions: Annotated[
        Path | None,
        typer.Option(metavar="FILE.csv", help="Write where the antennas of a run were, t,name,x,y,z (s, m) a line."),
    ] = None,
    coverage: Annotated[str | None, typer.Option(metavar="VEHICLE", help="Draw a coverage map of this vehicle.")] = None,
    at: Annotated[float | None, typer.Option(metavar="S", help="Map: time in the run, s [at its start].")] = None,
    size: Annotated[int | None, typer.Option(metavar="BYTES", min=0, help="Map: payload of the frames [100].")] = None,
    height: Annotated[float | None, typer.Option(metavar="M", help="Map: height of the receivers' antennas [0.5].")] = None,
    resolution: Annotated[
        float | None, typer.Option(metavar="M", help="Map: distance of places [about 150 along the longer side].")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Map: file [coverage-VEHICLE.png]; paths: file [paths.parquet].")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Map, paths: seed [the scenario's].")] = None,
    set_: Annotated[Changes, changes("Map, paths: change a key of the scenario.")] = None,
    json: AsJson = False,
    trust: Trust = False,
) -> None:
    """Explain the radio: delivery, losses and link budgets of a run; coverage, and paths of rays, of a scenario.

    Examples: vcmvsp radio runs/formation-circle-1 --link car1/car2 --frame worst;
    vcmvsp radio formation-circle --coverage car1 --out map.png;
    vcmvsp radio town.toml --paths points.csv --out paths.parquet
    """
    of_map = {"at": at, "size": size, "height": height, "resolution": resolution, "out": out, "seed": seed, "set": set_ or None}
    options: dict[str, Any] = {name: value for name, value in of_map.items() if value is not None}
    if positions is not None:
        answer, text = _places(Path(what), positions, beside=(options or None, link, frame, coverage, paths))
    elif paths is not None:
        others = {"link": link, "frame": frame, "coverage": coverage, **options}
        for name, value in others.items():
            if value is not None and name not in ("out", "seed", "set"):
                raise UsageError(f"--paths and --{name} exclude each other: leave one out")
        answer, text = _traced(what, paths, options, json=json, trust=trust)
    elif coverage is None:
        if options:
            raise UsageError(f"--{next(iter(options))} needs --coverage VEHICLE")
        answer, text = _explained(Path(what), link, frame, trust=trust)
    else:
        if link is not None or frame is not None:
            raise UsageError("--coverage draws a map; --link and --frame query a run: use either the one or the others")
        for name, value in options.items():
            if isinstance(value, float) and not (math.isfinite(value) and (name != "resolution" or value > 0.0)):
                raise UsageError(f"--{name} {value}: must be a {'positive' if name == 'resolution' else 'finite'} number")
        answer, text = _draw_coverage(what, coverage, options, json=json, trust=trust)
    sys.stdout.write(to_json(finite(answer)) if json else text)


class Traffic(StrEnum):
    """Rules by which radios send."""

    PERIODIC = "periodic"
    JITTER = "jitter"
    POISSON = "poisson"
    SATURATED = "saturated"


def channel_command(
    preset: Preset,
    positions: Annotated[
        Path,
        typer.Option(metavar="FILE.csv", help="A line x,y,z (m) for each vehicle's antenna, or t,name,x,y,z (s, m)."),
    ],
    size: Size,
    duration: Annotated[float, typer.Option(metavar="S", help="Frames are sent at 0 <= t < S.")],
    rate: Annotated[
        float | None, typer.Option(metavar="HZ", help="Frames per second of each vehicle; not needed by saturated.")
    ] = None,
    traffic: Annotated[
        Traffic, typer.Option(help="Times of the frames; saturated: the next frame when the former is decided.")
    ] = Traffic.PERIODIC,
    jitter: Annotated[
        float | None,
        typer.Option(metavar="SHARE", help="Traffic jitter: period * (1 + U(-SHARE, SHARE)) each [0.1]."),
    ] = None,
    to: Annotated[str | None, typer.Option(metavar="NAME", help="All other vehicles send to this one [broadcasts].")] = None,
    set_: OfLayer = None,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.parquet", help="Also write a row per frame and receiver, as in radio.parquet.")
    ] = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Simulate frames of vehicles at rest or on given paths and count receptions, without physics and agents.

    The first frame of a vehicle is at a random instant of its first period. Lines x,y,z are the vehicles v0, v1, ...; between
    lines t,name,x,y,z a vehicle moves in a straight line.

    Examples: vcmvsp channel --preset wifi-b-1 --positions cars.csv --rate 10 --size 100 --duration 30;
    vcmvsp channel --preset wifi-g-6 --positions paths.csv --traffic saturated --to car1 --size 1000 --duration 10
    """
    from vcmvsp.cosim.assembly.parts import channel_trial
    from vcmvsp.cosim.config import binding
    from vcmvsp.cosim.scenario.schema import Duration
    from vcmvsp.cosim.terminal.progress import Progress
    from vcmvsp.cosim.types import Probability, Rate, Seed

    if rate is None and traffic is not Traffic.SATURATED:
        raise UsageError(f"--traffic {traffic.value} needs --rate HZ")
    if jitter is not None and traffic is not Traffic.JITTER:
        raise UsageError("--jitter needs --traffic jitter")
    waypoints = channel_trial.read_positions(positions)
    if to is not None and to not in waypoints.names:
        raise UsageError(f"--to: {binding.unknown('vehicle', to, waypoints.names)}")
    share = 0.1 if jitter is None else jitter
    plan = channel_trial.TrialTraffic(
        waypoints=waypoints,
        rate_hz=1.0 if rate is None else binding.convert(rate, Rate, key="--rate"),
        size_bytes=_payload(size),
        duration_s=binding.convert(duration, Duration, key="--duration"),
        kind=traffic.value,
        jitter=binding.convert(share, Probability, key="--jitter"),
        to=to,
        seed=binding.convert(seed, Seed, key="--seed"),
    )
    if not plan.senders:
        raise UsageError(f"--to {to}: {positions} has no other vehicle that could send")
    channel, _, source = _channel(preset, set_, plan.names)
    try:
        with contextlib.ExitStack() as stack:
            progress = stack.enter_context(Progress(quiet=quiet))
            rows = None if out is None else stack.enter_context(_rows(out, preset, plan))
            counts = channel_trial.run(channel, plan, sink=None if rows is None else rows.add, progress=progress.on_instant)
    except ScenarioError as error:  # the mac does not fit the phy
        if error.source:
            raise
        raise ScenarioError(error.problem, key="mac.kind", source=_changed(source, "mac", "phy")) from error
    if json:
        sys.stdout.write(jsons.dumps(counts, indent=2, allow_nan=False) + "\n")
    else:
        sys.stdout.write(_summary(preset, counts, len(plan.names), out))


def per_command(
    preset: Preset,
    snr: Annotated[str, typer.Option(metavar="START:STOP:STEP", help="Signal-to-noise ratio, dB.")],
    size: Size,
    model: Annotated[
        str, typer.Option(metavar="NAME", help="wifi-g-*, wifi-a-*: table, yans, nist; wifi-b-*: dsss; zigbee: oqpsk.")
    ] = "default",
    json: AsJson = False,
) -> None:
    """Tabulate packet errors by SNR.

    success and per are rates of the whole frame with header; payload_success is without the header.

    Example: vcmvsp per --preset wifi-g-6 --model nist --snr -2:6:0.5 --size 100
    """
    from vcmvsp.cosim.assembly.parts import channel_trial as curves

    snr_db, size_bytes = curves.grid(snr, "--snr"), _payload(size)
    errors, name = curves.error_rate(_channel(preset, None)[0].phy, model)
    columns = curves.packet_errors(errors, snr_db, size_bytes)
    _print({"preset": preset, "model": name, "size_bytes": size_bytes}, columns, json=json)


def pathloss_command(
    preset: Preset,
    distance: Annotated[str, typer.Option(metavar="START:STOP:STEP", help="Distance of two antennas, m.")],
    set_: OfLayer = None,
    json: AsJson = False,
) -> None:
    """Tabulate mean loss, received level and SNR by distance, from the path loss alone.

    Example: vcmvsp pathloss --preset wifi-b-1 --set path_loss.exponent=2 --distance 10:100:10
    """
    from vcmvsp.cosim.assembly.parts import channel_trial as curves

    distance_m = curves.grid(distance, "--distance")
    if distance_m.min() < 0.0:
        raise UsageError(f"--distance {distance}: distances must not be negative")
    channel = _channel(preset, set_)[0]
    _print({"preset": preset}, curves.mean_levels(channel.budgets.path_loss, channel.phy, distance_m), json=json)


def _explained(folder: Path, link: str | None, frame: str | None, *, trust: bool) -> tuple[dict[str, Any], str]:
    from vcmvsp.cosim.analysis import link_text, links

    log = links.Log(folder, say)
    head = {"schema": links.SCHEMA, "scenario": log.facts.scenario, "seed": log.facts.seed}
    pairs = log.pairs(link or "*/*")
    single = link is not None and not set("*?[") & set(link)
    if link is not None:
        log.only(pairs)
    if frame is not None:
        from vcmvsp.cosim.analysis.link_budget import frame_report

        if not single:
            raise UsageError(f"--frame {frame} needs one link: add --link SENDER/RECEIVER")
        report = frame_report(log, pairs[0], frame, trust=trust)
        return {**head, "frame": report}, link_text.frame_text(report)
    if single:
        link_report = links.link_report(log, pairs[0])
        return {**head, "links": [link_report]}, link_text.link_text(link_report)
    rows = links.overview(log, link or "*/*")
    text = link_text.overview_text(rows, log.vehicles)
    if link is not None:
        rows = [links.link_report(log, (row["sender"], row["receiver"])) for row in rows]
    return {**head, "links": rows}, text


def _places(folder: Path, target: Path, *, beside: tuple[object, ...]) -> tuple[dict[str, Any], str]:
    from vcmvsp.cosim.analysis.coverage import write_antennas

    if any(value is not None for value in beside):
        raise UsageError("--positions excludes --link, --frame, --coverage, --paths and their options: leave them out")
    if not (folder / "scenario.toml").is_file():
        raise UsageError(f"--positions needs the folder of a run: {folder} has no scenario.toml")
    lines = write_antennas(folder, target)
    return {"file": str(target), "positions": lines}, f"{lines} positions of antennas: {target}\n"


def _traced(what: str, points: Path, options: dict[str, Any], *, json: bool, trust: bool) -> tuple[dict[str, Any], str]:
    from vcmvsp.cosim.analysis import ray_paths
    from vcmvsp.cosim.scenario import loader

    settings = loader.settings_of(options.get("set", []))
    table = ray_paths.ray_paths(what, points, seed=options.get("seed"), set=settings, trust=trust)
    out = options.get("out")
    if json and out is None:
        return {"paths": table.to_pylist()}, ""
    out = out or Path("paths.parquet")
    ray_paths.save(table, out)
    return {"file": str(out), "paths": table.num_rows}, ray_paths.summary(table, out)


def _draw_coverage(
    what: str, vehicle: str, arguments: dict[str, Any], *, json: bool, trust: bool
) -> tuple[dict[str, Any], str]:
    from vcmvsp.cosim.analysis import coverage as maps
    from vcmvsp.cosim.scenario import loader

    names = {"at": "at_s", "size": "size_bytes", "height": "height_m", "resolution": "resolution_m", "seed": "seed"}
    settings = loader.settings_of(arguments.get("set", []))
    options = {names[name]: arguments[name] for name in arguments if name in names}
    coverage_map = maps.coverage(what, vehicle, set=settings, trust=trust, **options)
    answer = maps.to_table(coverage_map)
    out = arguments.get("out")
    if json and out is None:
        return answer, ""
    out = out or Path(f"coverage-{vehicle}.png")
    from vcmvsp.cosim.plots import radio_plots, style

    try:
        style.save_png(radio_plots.coverage(coverage_map), out)
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror or error}") from error
    return {**answer, "file": str(out)}, maps.summary(coverage_map) + f"map: {out}\n"


def _channel(
    preset: str, arguments: Sequence[str] | None, vehicles: Sequence[str] = ()
) -> "tuple[Channel, dict[str, Any], Source]":
    """A preset's channel with changed keys, its complete tables, and the source of the keys."""
    from vcmvsp.cosim.assembly import radio
    from vcmvsp.cosim.assembly.parts.presets import LAYERS
    from vcmvsp.cosim.config import binding
    from vcmvsp.cosim.config.provenance import Source
    from vcmvsp.cosim.scenario.loader import assign, settings_of

    source = Source("the radio", Path())
    source.note_set("preset", f"--preset {preset}")
    tables: dict[str, Any] = {"preset": preset}
    for argument in arguments or []:
        ((key, value),) = settings_of([argument], "path_loss.exponent=2.5").items()
        source.note_set(key, f"--set {argument}")
        layer, _, inner = key.partition(".")
        if layer not in LAYERS:
            raise source.error(binding.unknown("layer", layer, LAYERS), key)
        if not inner:
            raise source.error(f"write LAYER.KEY=VALUE, e.g. {layer}.kind=...", key)
        assign(tables, key, value, source)
    channel, resolved = radio.build(tables, source, key="", vehicles=vehicles)
    return channel, resolved, source


def _changed(source: "Source", *layers: str) -> str:
    places = dict.fromkeys(source.of(layer) for layer in layers)
    return ", ".join(place for place in places if place != source.name) or source.name


def _payload(size: int) -> int:
    import msgspec

    from vcmvsp.cosim.config import binding

    return binding.convert(size, Annotated[int, msgspec.Meta(ge=1, le=10_000_000)], key="--size")


def _rows(out: Path, preset: str, plan: "TrialTraffic") -> "RowFile":
    from vcmvsp.cosim.assembly.parts.channel_trial import RowFile
    from vcmvsp.cosim.tables.schema import RunFacts

    facts = RunFacts(scenario=preset, seed=plan.seed, end_ns=plan.end_ns, vehicles=plan.names)
    return RowFile(out, facts)


def _print(about: Mapping[str, Any], columns: Mapping[str, list[float]], *, json: bool) -> None:
    if json:
        lines = [
            f"  {jsons.dumps(name)}: {jsons.dumps(value, allow_nan=False)}" for name, value in {**about, **columns}.items()
        ]
        sys.stdout.write("{\n" + ",\n".join(lines) + "\n}\n")
        return
    sys.stdout.write(f"# {', '.join(f'{name} {value}' for name, value in about.items())}\n")
    widths = [max(12, len(name)) for name in columns]
    sys.stdout.write("  ".join(f"{name:>{width}}" for name, width in zip(columns, widths, strict=True)) + "\n")
    for row in zip(*columns.values(), strict=True):
        sys.stdout.write("  ".join(f"{value:>{width}.6g}" for value, width in zip(row, widths, strict=True)) + "\n")


def _summary(preset: str, counts: Mapping[str, Any], vehicles: int, out: Path | None) -> str:
    lines = [f"{preset}: {counts['frames']} frames of {vehicles} vehicles"]
    if counts["delivery_ratio"] is not None:
        lost = ", ".join(f"{count} {cause}" for cause, count in counts["losses"].items()) or "none lost"
        lines.append(f"delivered: {100 * counts['delivery_ratio']:.2f} % of frame x receiver ({lost})")
    if counts["receptions"]:
        delay = ", ".join(f"{name} {1000 * value:.4g}" for name, value in counts["delay_s"].items())
        lines.append(f"delay:     {delay} ms")
    lines.append(f"cpu:       {counts['cpu_s']:.2f} s")
    if out is not None:
        lines.append(f"rows:      {out}")
    return "\n".join(lines) + "\n"


def calibrate_command(
    links: Annotated[
        Path, typer.Argument(metavar="LINKS.csv", help="Columns time,ax,ay,az,bx,by,bz,rssi_dbm[,received], in s, m, dBm.")
    ],
    tx_power: Annotated[float, typer.Option(metavar="DBM", help="Transmitted power, including antenna gains.")] = 0.0,
    reference_distance: Annotated[float, typer.Option(metavar="M", help="Distance of the reference level, m.")] = 1.0,
    sensitivity: Annotated[
        float | None, typer.Option(metavar="DBM", help="Sensitivity: weaker frames are lost [the least received level].")
    ] = None,
    world: Annotated[
        str | None, typer.Option(metavar="SCENARIO", help="Scenario with the walls: fit the loss of each material.")
    ] = None,
    rays: Annotated[bool, typer.Option("--rays", help="Fit an offset to the rays of SCENARIO's radio instead.")] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for radio.toml and calibration.png.")] = None,
    json: AsJson = False,
) -> None:
    """Fit path loss, shadowing, walls and fading to a measured log; with standard errors.

    With --rays: an offset, and what is left, beside log-distance; no picture.

    Example: vcmvsp calibrate links.csv --tx-power 16 --sensitivity -90 --world lab.toml --out lab-radio
    """
    import msgspec

    from vcmvsp.cosim.assembly.parts import calibration as fits

    for option, value in (
        ("--tx-power", tx_power),
        ("--sensitivity", sensitivity),
        ("--reference-distance", reference_distance),
    ):
        if value is not None and not math.isfinite(value):
            raise UsageError(f"{option} {value}: must be a finite number")
    if out is not None and out.exists() and not out.is_dir():
        raise UsageError(f"--out {out}: is a file; name a folder")
    if rays and world is None:
        raise UsageError("--rays needs the scenario whose rays are fitted: add --world SCENARIO")
    options: dict[str, Any] = {
        "tx_power_dbm": tx_power,
        "reference_distance_m": reference_distance,
        "sensitivity_dbm": sensitivity,
    }
    figure: dict[str, Any] | None = None
    calibration: Calibration | RayCalibration
    if rays and world is not None:
        traced, path_loss = fits.rays_of(world)
        _, calibration = fits.calibrate_file(links, fits.fit_rays, loss_db=traced.pair_loss_db, path_loss=path_loss, **options)
    else:
        sightline = None if world is None else fits.sightline_of(world)
        log, by_distance = fits.calibrate_file(links, sightline=sightline, **options)
        calibration, figure = by_distance, None if out is None else fits.figure_data(log, by_distance, sightline)
    if out is not None:
        write_calibration(out, calibration, figure)
    if json:
        sys.stdout.write(to_json({**msgspec.to_builtins(calibration), "radio": calibration.table()}))
        return
    sys.stdout.write(f"{calibration.summary()}\n\n{calibration.toml()}")
    if out is not None:
        names = ["radio.toml", "calibration.png"] if figure else ["radio.toml"]
        sys.stdout.writelines(f"{out / name}\n" for name in names)


def write_calibration(folder: Path, calibration: "Calibration | RayCalibration", figure_data: dict[str, Any] | None) -> None:
    """Write ``radio.toml`` of a calibration (`netsim.calibration`) and, from the data of its figure, ``calibration.png``."""
    from vcmvsp.cosim.plots.radio_plots import draw_calibration
    from vcmvsp.cosim.plots.style import save_png

    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        write_whole(folder / "radio.toml", calibration.toml())
        if figure_data is not None:
            save_png(draw_calibration(**figure_data), folder / "calibration.png")


def calibrate_recognition_command(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A built-in scenario, or a file.")],
    vehicle: Annotated[
        str | None, typer.Option(metavar="NAME", help="Vehicle with the camera [the first that searches targets].")
    ] = None,
    height: Annotated[float | None, typer.Option(metavar="M", help="Height of the vehicle [of its search].")] = None,
    frames: Annotated[int, typer.Option(metavar="N", help="Number of pictures; every other one shows a target.")] = 200,
    cell: Annotated[float | None, typer.Option(metavar="M", help="Edge of a map cell [of its search].")] = None,
    seed: Annotated[int, typer.Option(metavar="N", help="Seed of the places; the world keeps the scenario's seed.")] = 0,
    set_: Annotated[Changes, changes("Change a key, e.g. world.seed=3.")] = None,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Measure p and q of a search: the detection rate of a look at a cell with a target, and the false-alarm rate without.

    Takes pictures at random places in the world of the scenario, with its camera and targets, and runs the detector.
    The last two lines of the output are for the scenario.

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
    with stdout_to_stderr(), StatusDisplay(quiet=quiet) as progress:
        settings = scenarios.settings_of(set_ or [])
        snapshots = Snapshots(scenario, vehicle=vehicle, height_m=height, cell_m=cell, seed=seed, settings=settings)
        for number in range(frames):
            rates.add(snapshots.take(number, frames))
            progress.show(f"{number + 1} of {frames} pictures", number + 1, frames)
    about = {
        "scenario": scenario,
        "vehicle": snapshots.vehicle,
        "height_m": snapshots.height_m,
        "cell_m": snapshots.cell_m,
        "frames": frames,
    }
    sys.stdout.write(to_json({**about, **rates.plain()}) if json else _text(about, rates, snapshots))


def _text(about: dict[str, Any], rates: "Rates", snapshots: "Snapshots") -> str:
    lines = [
        f"{about['vehicle']} of {about['scenario']}: {about['frames']} pictures from {about['height_m']:g} m, "
        f"cells of {about['cell_m']:g} m",
        "",
    ]
    shares: dict[str, Share] = {
        "p, share of hits in looks at cells with a target": rates.p,
        "q, share of hits in looks at cells without a target": rates.q,
        "precision": rates.precision,
        "recall": rates.recall,
        "recall, unoccluded": rates.unoccluded,
        **{f"recall, unoccluded, {ring} of the picture": each for ring, each in rates.by_ring.items()},
    }
    lines += aligned((name, _words(each)) for name, each in shares.items())
    lines += ["", f"[{snapshots.table}]", f"p = {_number(rates.p.mean)}", f"q = {_number(rates.q.mean)}", ""]
    if rates.p.mean <= rates.q.mean:
        lines += ["# p must be greater than q: these looks carry no information for the map", ""]
    return "\n".join(lines)


def _words(share: "Share") -> str:
    low, high = share.interval
    value = "-" if not share.of else f"{share.value:.3g}"
    return f"{value:>8}  {low:.3g} to {high:.3g} (95 %), {share.part} of {share.of}"


def _number(value: float) -> str:
    """A number with two significant digits, also of its distance to 1."""
    digits = 1 - math.floor(math.log10(min(value, 1.0 - value)))
    return f"{value:.{digits}f}"
