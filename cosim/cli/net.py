"""``vcmvsp net``: an IP network of vehicles for unmodified programs, one namespace per vehicle (``[bridge.ip]``)."""

import contextlib
import json as jsons
import sys
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from vcmvsp.cosim.cli.options import PROGRAM, AsJson, Sets
from vcmvsp.cosim.cli.run import Force, Out, Quiet, ScenarioName, Seed, View, ViewHost, ViewPort, conduct
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.text import aligned
from vcmvsp.cosim.view import HOST, PORT

if TYPE_CHECKING:
    from vcmvsp.cosim.assembly.parts.networks import RunNetwork, Space

RunName = Annotated[str | None, typer.Option("--run", metavar="NAME", help="Run whose network is meant, if there are several.")]
NEEDS = "network namespaces need {}: start it as root (sudo), or in a container with --privileged"

net_app = typer.Typer(
    name="net",
    help="A network of the vehicles for unchanged programs: each vehicle is a network namespace with its own address.\n\n"
    "Its radio carries what programs send. Needs Linux and root.\n\nStart with: vcmvsp net up formation-circle",
    no_args_is_help=True,
    rich_markup_mode=None,
)


@net_app.command("up", short_help="Run a scenario with a namespace for each vehicle", epilog=PROGRAM)
def up_command(
    scenario: ScenarioName,
    duration: Annotated[
        float | None, typer.Option(metavar="S", help="Duration, s; Ctrl-C ends it earlier [the scenario's].")
    ] = None,
    network: Annotated[
        str | None, typer.Option(metavar="ADDRESS/BITS", help="IPv4 network of all vehicles [the scenario's, or 10.77.0.0/16].")
    ] = None,
    seed: Seed = None,
    set_: Sets = None,
    out: Out = None,
    force: Force = False,
    json: AsJson = False,
    quiet: Quiet = False,
    view: View = False,
    view_host: ViewHost = HOST,
    view_port: ViewPort = PORT,
) -> None:
    """Run a scenario in real time, with a network namespace for the programs of each vehicle.

    Remains of a killed run with this name are removed first. With sudo, only the process that creates the interfaces has
    root's rights: the scenario runs as the calling user.

    Example: vcmvsp net up formation-circle --duration 600 --set radio.loss.probability=0.1
    """
    from vcmvsp.cosim.assembly import bridge
    from vcmvsp.cosim.assembly.parts import networks
    from vcmvsp.cosim.scenario import loader as scenarios

    _check_rights()
    networks.leave_root()
    sets = list(set_ or [])
    if duration is not None:
        sets.append(f"duration_s={duration}")
    parsed, _ = scenarios.load(scenario, settings=scenarios.settings_of(sets), seed=seed)
    try:
        with contextlib.suppress(PermissionError):  # the process that makes the interfaces reports it
            networks.check_free(parsed.name)
    except OSError as error:
        raise UsageError(str(error)) from error
    doors = [name for name, content in parsed.bridge.doors.items() if bridge.kind_of(name, content) == "ip"]
    door = doors[0] if doors else "ip"
    if network is not None:
        sets.append(f"bridge.{door}.network={network}")
    elif not doors:
        sets.append("bridge.ip={}")
    page = (view_host, view_port) if view else None
    conduct(None, scenario, sets, out, seed=seed, realtime=1.0, force=force, json=json, quiet=quiet, page=page)


@net_app.command("exec", short_help="Start a program in a vehicle's namespace")
def exec_command(
    vehicle: Annotated[str, typer.Argument(metavar="VEHICLE", help="Vehicle in whose namespace it runs.")],
    command: Annotated[list[str], typer.Argument(metavar="-- COMMAND...", help="The program and its arguments.")],
    run: RunName = None,
) -> None:
    """Run a program in the network namespace of a vehicle, where other vehicles have their names.

    Input, output, exit code and signals are those of the program.

    Example: vcmvsp net exec car1 -- ping car2
    """
    from vcmvsp.cosim.assembly.parts import networks

    _check_rights()
    network = _chosen(run)
    space = network.space(vehicle)
    if space is None:
        vehicles = ", ".join(each.vehicle for each in network.spaces)
        raise UsageError(f"{vehicle}: run {network.run} has no namespace for this vehicle; vehicles: {vehicles}")
    sys.stdout.flush()
    try:
        networks.run_inside(network, space, command)
    except OSError as error:
        file = f"{error.filename}: " if error.filename else ""
        raise UsageError(f"{' '.join(command)}: {file}{error.strerror}") from error


@net_app.command("status", short_help="Show the networks on this machine")
def status_command(json: AsJson = False) -> None:
    """Show the networks on this machine: addresses, and whether their runs are alive.

    Example: vcmvsp net status
    """
    from vcmvsp.cosim.assembly.parts import networks

    try:
        run_networks = networks.networks()
    except OSError as error:  # a file of another user, not readable
        raise UsageError(f"{error.filename}: {error.strerror}: repeat as root (sudo)") from error
    if json:
        sys.stdout.write(f"{jsons.dumps(msgspec.to_builtins(run_networks))}\n")
    elif run_networks:
        sys.stdout.writelines(f"{line}\n" for each in run_networks for line in _lines(each))
    else:
        sys.stdout.write("no run has a network on this machine\n")


@net_app.command("down", short_help="Remove the networks of killed runs")
def down_command(
    run: Annotated[str | None, typer.Argument(metavar="[RUN]", help="Whose [all].")] = None,
    force: Annotated[bool, typer.Option("--force", help="Also end runs that are alive, and remove their networks.")] = False,
) -> None:
    """Remove networks of killed runs; networks of running ones stay.

    Example: vcmvsp net down
    """
    from vcmvsp.cosim.assembly.parts import networks

    _check_rights()
    run_networks = networks.networks()
    chosen = [each for each in run_networks if each.run == run or (run is None and (force or not each.alive))]
    for each in chosen:
        if each.alive and not force:
            raise UsageError(f"run {each.run} is alive (process {each.pid}): end it with Ctrl-C, or add --force")
        try:
            networks.clear(each.run, force=force)
        except OSError as error:
            raise UsageError(f"the network of {each.run} cannot be removed: {error}") from error
        sys.stdout.write(f"{each.run}: gone\n")
    if not chosen:
        sys.stdout.write("no network to remove\n")


def _check_rights() -> None:
    from vcmvsp.cosim.assembly.parts import networks

    if lacks := networks.missing():
        raise UsageError(NEEDS.format(lacks))


def _chosen(run: str | None) -> "RunNetwork":
    """The network of a running run; without a name, of the only one."""
    from vcmvsp.cosim.assembly.parts import networks

    alive = [each for each in networks.networks() if each.alive]
    matches = [each for each in alive if run is None or each.run == run]
    if len(matches) == 1:
        return matches[0]
    if not alive:
        raise UsageError("no run has a network on this machine: start one with 'vcmvsp net up SCENARIO'")
    names = ", ".join(each.run for each in alive)
    raise UsageError(f"--run {run}: no such run; runs: {names}" if run else f"several runs: add --run with one of {names}")


def _lines(network: "RunNetwork") -> Iterator[str]:
    state = f"alive, process {network.pid}" if network.alive else "killed; remove it with 'vcmvsp net down'"
    yield f"{network.run}: {state}"
    rows = [(space, row) for space in network.spaces for row in _rows(space)]
    lines = aligned(row for _, row in rows)
    for (each, (name, *_)), line in zip(rows, lines, strict=True):
        behind = f"  before {', '.join(each.port.behind)} ({each.port.interface})" if each.port is not None and name else ""
        yield f"  {line}{behind}"


def _rows(space: "Space") -> list[tuple[str, ...]]:
    """Vehicle and addresses; of several radios one for each, with its name."""
    if not space.radios:
        return [(space.vehicle, *space.addresses)]
    names = [space.vehicle, *[""] * (len(space.radios) - 1)]
    return [(name, each.radio, *each.addresses) for name, each in zip(names, space.radios, strict=True)]
