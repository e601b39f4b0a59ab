"""The channel alone, from the command line: ``vcmvsp channel``, ``vcmvsp per``, ``vcmvsp pathloss``."""

import contextlib
import json as jsons
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.errors import Interrupted, ScenarioError, UsageError

if TYPE_CHECKING:
    from vcmvsp.cosim.config.provenance import Source

Preset = Annotated[str, typer.Option(metavar="NAME", help="A preset of the radio, e.g. ideal, wss, wifi-b-1, zigbee.")]
Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a key of a layer, e.g. path_loss.exponent=2.5."),
]
Size = Annotated[int, typer.Option(metavar="BYTES", help="Payload of a frame; the standard's headers are added.")]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("channel")(channel_command)
    app.command("per")(per_command)
    app.command("pathloss")(pathloss_command)


def channel_command(
    preset: Preset,
    positions: Annotated[Path, typer.Option(metavar="FILE.csv", help="A line x,y,z (m) for each vehicle's antenna.")],
    rate: Annotated[float, typer.Option(metavar="HZ", help="Frames a second of each vehicle.")],
    size: Size,
    duration: Annotated[float, typer.Option(metavar="S", help="Frames are sent at 0 <= t < S.")],
    set_: Sets = None,
    seed: Annotated[int, typer.Option(help="Of all random numbers.")] = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.parquet", help="Also write a row per frame and receiver, as in radio.parquet.")
    ] = None,
    json: AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
) -> None:
    """Let vehicles stand still and broadcast; count what arrives.

    Each sends periodically from a random instant of its first period on. No physics, no agents: the channel alone.

    Example: vcmvsp channel --preset wifi-b-1 --positions cars.csv --rate 10 --size 100 --duration 30 --set path_loss.exponent=2
    """
    from vcmvsp.cosim.config import binding, registry
    from vcmvsp.cosim.scenario.schema import Duration
    from vcmvsp.cosim.terminal.progress import Progress
    from vcmvsp.cosim.types import Rate, Seed

    trial = registry.piece("channel trial")
    plan = trial.Broadcasts(
        position=registry.piece("positions file")(positions),
        rate_hz=binding.convert(rate, Rate, key="--rate"),
        size_bytes=_payload(size),
        duration_s=binding.convert(duration, Duration, key="--duration"),
        seed=binding.convert(seed, Seed, key="--seed"),
    )
    channel, _, source = _channel(preset, set_, plan.names)
    try:
        with contextlib.ExitStack() as stack:
            progress = stack.enter_context(Progress(quiet=quiet))
            rows = None if out is None else stack.enter_context(_rows(out, preset, plan))
            counts = trial.run(channel, plan, sink=None if rows is None else rows.add, progress=progress.on_instant)
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
    except ScenarioError as error:  # a mac that does not go with the phy
        if error.source:
            raise
        raise ScenarioError(error.problem, key="mac.kind", source=_changed(source, "mac", "phy")) from error
    if json:
        sys.stdout.write(jsons.dumps(counts, indent=2, allow_nan=False) + "\n")
    else:
        sys.stdout.write(_summary(preset, counts, len(plan.names), out))


def per_command(
    preset: Preset,
    snr: Annotated[str, typer.Option(metavar="START:STOP:STEP", help="Signal over noise, dB.")],
    size: Size,
    model: Annotated[
        str, typer.Option(metavar="NAME", help="wifi-g-*, wifi-a-*: table, yans, nist; wifi-b-*: dsss; zigbee: oqpsk.")
    ] = "default",
    json: AsJson = False,
) -> None:
    """Tabulate packet errors by SNR.

    success and per are those of a whole frame with this payload, its header included; payload_success leaves the header out.

    Example: vcmvsp per --preset wifi-g-6 --model nist --snr -2:6:0.5 --size 100
    """
    from vcmvsp.cosim.config import registry

    curves = registry.piece("channel curves")
    snr_db, size_bytes = curves.grid(snr, "--snr"), _payload(size)
    errors, name = curves.error_rate(_channel(preset, None)[0].phy, model)
    columns = curves.packet_errors(errors, snr_db, size_bytes)
    _print({"preset": preset, "model": name, "size_bytes": size_bytes}, columns, json=json)


def pathloss_command(
    preset: Preset,
    distance: Annotated[str, typer.Option(metavar="START:STOP:STEP", help="Between two antennas, m.")],
    set_: Sets = None,
    json: AsJson = False,
) -> None:
    """Tabulate loss, received level and SNR by distance: mean values, by the path loss alone.

    Example: vcmvsp pathloss --preset wifi-b-1 --set path_loss.exponent=2 --distance 10:100:10
    """
    from vcmvsp.cosim.config import factory, registry

    curves = registry.piece("channel curves")
    distance_m = curves.grid(distance, "--distance")
    if distance_m.min() < 0.0:
        raise UsageError(f"--distance {distance}: no distance is negative")
    channel, resolved, source = _channel(preset, set_)
    path_loss, _ = factory.build("path_loss", resolved["path_loss"], key="path_loss", source=source)
    _print({"preset": preset}, curves.mean_levels(path_loss, channel.phy, distance_m), json=json)


def _channel(
    preset: str, arguments: Sequence[str] | None, vehicles: Sequence[str] = ()
) -> "tuple[Any, dict[str, Any], Source]":
    """A channel of a preset with some keys changed, its tables with everything filled in, and where keys came from."""
    from vcmvsp.cosim.assembly import radio
    from vcmvsp.cosim.config import messages, registry
    from vcmvsp.cosim.config.provenance import Source
    from vcmvsp.cosim.scenario.loader import value_of

    source = Source("the radio", Path())
    source.note_set("preset", f"--preset {preset}")
    tables: dict[str, Any] = {"preset": preset}
    layers = registry.piece("radio presets").LAYERS
    for argument in arguments or []:
        key, equals, text = (part.strip() for part in argument.partition("="))
        if not equals or not key:
            raise UsageError(f"--set {argument}: write KEY=VALUE, e.g. --set path_loss.exponent=2.5")
        source.note_set(key, f"--set {argument}")
        layer, *inner = key.split(".")
        if layer not in layers:
            raise ScenarioError(messages.unknown("layer", layer, layers), key=key, source=source.of(key))
        if not inner:
            raise ScenarioError(f"write LAYER.KEY=VALUE, e.g. {layer}.kind=...", key=key, source=source.of(key))
        here = tables.setdefault(layer, {})
        for part in inner[:-1]:
            here = here.setdefault(part, {})
            if not isinstance(here, dict):
                raise ScenarioError(f"'{part}' is a value, not a table", key=key, source=source.of(key))
        here[inner[-1]] = value_of(text)
    channel, resolved = radio.build(tables, source, key="", vehicles=vehicles)
    return channel, resolved, source


def _changed(source: "Source", *layers: str) -> str:
    """Which arguments have changed these layers."""
    places = dict.fromkeys(source.of(layer) for layer in layers)
    return ", ".join(place for place in places if place != source.name) or source.name


def _payload(size: int) -> int:
    import msgspec

    from vcmvsp.cosim.config import binding

    checked: int = binding.convert(size, Annotated[int, msgspec.Meta(ge=1, le=10_000_000)], key="--size")
    return checked


def _rows(out: Path, preset: str, plan: Any) -> Any:
    from vcmvsp.cosim.config import registry
    from vcmvsp.cosim.tables.schema import RunFacts

    facts = RunFacts(scenario=preset, seed=plan.seed, end_ns=plan.end_ns, vehicles=plan.names)
    return registry.piece("row file")(out, facts)


def _print(about: Mapping[str, Any], columns: Mapping[str, list[float]], *, json: bool) -> None:
    """Columns of numbers, with a few words about them."""
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
    """What became of the frames, in a few lines."""
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
