"""The command line ``vcmvsp``. Parsing only: every command calls what Python users call; heavy parts load when needed."""

import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli import robot, stop
from vcmvsp.cosim.cli.bench import bench_command
from vcmvsp.cosim.cli.calibrate import calibrate_command
from vcmvsp.cosim.cli.calibrate_recognition import calibrate_recognition_command
from vcmvsp.cosim.cli.channel import register
from vcmvsp.cosim.cli.emulate import emulate_app
from vcmvsp.cosim.cli.export import export_command
from vcmvsp.cosim.cli.figure import figure_command
from vcmvsp.cosim.cli.keys import keys_app
from vcmvsp.cosim.cli.kinds import list_command, show_command, world_command
from vcmvsp.cosim.cli.launch import launch_command
from vcmvsp.cosim.cli.net import net_app
from vcmvsp.cosim.cli.new import new_command
from vcmvsp.cosim.cli.options import AsJson, DialInsecurely, KeysOfVehicle
from vcmvsp.cosim.cli.radio import radio_command
from vcmvsp.cosim.cli.reference import reference_command
from vcmvsp.cosim.cli.replay import replay_command
from vcmvsp.cosim.cli.report import report_command
from vcmvsp.cosim.cli.run import ScenarioName, Sets, run_command
from vcmvsp.cosim.cli.study import study_command
from vcmvsp.cosim.cli.validate import validate_command
from vcmvsp.cosim.cli.view import view_command
from vcmvsp.cosim.cli.watch import watch_command
from vcmvsp.cosim.errors import Interrupted, UsageError, VcmvspError
from vcmvsp.cosim.util.stdout import stdout_to_stderr

HANGS_UP = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
"""The end of a terminal is Ctrl-C too, unless somebody wants it ignored, as nohup does."""

app = typer.Typer(
    name="vcmvsp",
    help="Simulate many vehicles and the radio between them.\n\nStart with: vcmvsp run formation-circle",
    no_args_is_help=True,
    rich_markup_mode=None,  # rich help costs a third of a second at every start
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.command("run")(run_command)


@app.command("agent")
def agent_command(
    vehicle: Annotated[list[str], typer.Option(metavar="NAME", help="Whose agent to run; repeat for several.")],
    connect: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where the run listens, e.g. tls/192.168.1.10:7447.")],
    kind: Annotated[
        str | None, typer.Argument(metavar="[MODULE_OR_FILE:Class]", help="The agent's class; without it: the scenario's.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="A parameter of the agent, instead of the scenario's."),
    ] = None,
    keys: KeysOfVehicle = None,
    insecure: DialInsecurely = False,
) -> None:
    """Host agents for a run that is started with --agents zenoh.

    Example: vcmvsp agent my_agent.py:KeepGap --vehicle car2 --connect tls/192.168.1.10:7447 --keys car2.keys
    """
    from vcmvsp.cosim.config import registry
    from vcmvsp.cosim.scenario import loader as scenarios

    host = registry.piece("host process")
    why = host(
        connect,
        tuple(vehicle),
        kind=kind,
        folder=str(Path.cwd()),
        params=scenarios.settings_of(set_ or []),
        keys=keys,
        insecure=insecure,
        on_state=_say,
    )
    _say(why)


@app.command("check")
def check_command(scenario: ScenarioName, set_: Sets = None) -> None:
    """Check every key, kind and period of a scenario; run nothing.

    Example: vcmvsp check my_scenario.toml
    """
    from vcmvsp.cosim.scenario import loader as scenarios

    resolved = _checked(scenario, scenarios.settings_of(set_ or []))
    sys.stdout.write(f"{scenario}: fine ({len(resolved['vehicle'])} vehicles, {resolved['duration_s']:g} s)\n")


@app.command("plot")
def plot_command(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A folder that 'vcmvsp run' has left.")],
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Where to put the figures [RUN_DIR].")] = None,
    svg: Annotated[bool, typer.Option("--svg", help="As drawings (SVG) instead of pictures (PNG).")] = False,
) -> None:
    """Draw the figures of a run again.

    Example: vcmvsp plot runs/formation-circle-1
    """
    from vcmvsp.cosim.runs import api

    for path in api.plot(run_dir, out or run_dir, svg=svg):
        sys.stdout.write(f"{path}\n")


@app.command("doctor")
def doctor_command(
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Check the way to a run that listens there, instead.")
    ] = None,
    keys: Annotated[Path | None, typer.Option(metavar="FILE", help="This machine's certificate, for --connect.")] = None,
    insecure: DialInsecurely = False,
    json: AsJson = False,
) -> None:
    """Check this installation and make two short runs, or check the way to a run on another machine.

    Example: vcmvsp doctor --connect tls/192.168.1.10:7447 --keys car2.keys
    """
    from vcmvsp.cosim.cli import doctor

    if connect is None and (keys is not None or insecure):
        raise UsageError("--keys and --insecure say how to reach a run: add --connect ENDPOINT")
    checks = doctor.installation() if connect is None else doctor.connection(connect, keys, insecure=insecure)
    if json:
        with stdout_to_stderr():
            checks = iter(list(checks))
    raise SystemExit(doctor.report(checks, as_json=json))


@app.command("drive")
def drive_command(
    scenario: ScenarioName,
    vehicle: Annotated[str, typer.Option(metavar="NAME", help="Which one.")],
    command: Annotated[
        str,
        typer.Option(
            metavar="COMMAND", help="v=0.3,w=0.5 (forward, yaw rate), vx=,vy=,vz=,w= or x=,y=,z=[,yaw=][,speed=] in the air."
        ),
    ],
    seconds: Annotated[float, typer.Option(metavar="S", help="For how long.")] = 10.0,
    set_: Sets = None,
    json: AsJson = False,
) -> None:
    """Give one vehicle one command at the start and show its response; all others stand still.

    Example: vcmvsp drive lab-patrol --vehicle ugv1 --command "v=0.3,w=0.5" --seconds 5
    """
    from vcmvsp.cosim.runs import step_response
    from vcmvsp.cosim.scenario import loader as scenarios
    from vcmvsp.cosim.util.files import to_json

    with stdout_to_stderr():
        about = step_response.drive(scenario, vehicle, command, seconds, scenarios.settings_of(set_ or []))
    sys.stdout.write(to_json(about) if json else step_response.summary(about))


app.command("replay")(replay_command)
app.command("export")(export_command)
app.command("report")(report_command)
app.add_typer(emulate_app)
app.command("launch")(launch_command)
app.command("study")(study_command)
app.command("figure")(figure_command)
app.command("validate")(validate_command)
app.command("bench")(bench_command)
app.command("new")(new_command)
app.command("reference")(reference_command)
app.command("list")(list_command)
app.command("show")(show_command)
app.command("world")(world_command)
app.command("radio")(radio_command)
app.command("calibrate")(calibrate_command)
app.command("calibrate-recognition")(calibrate_recognition_command)
app.command("view")(view_command)
app.command("watch")(watch_command)
register(app)
stop.register(app)
robot.register(app)
app.add_typer(keys_app)
app.add_typer(net_app)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: one message and an exit code for whatever goes wrong."""
    if "_VCMVSP_COMPLETE" in os.environ:  # a shell asks what can stand next
        from vcmvsp.cosim.cli import completion

        completion.answer(app)
    for number in (
        signal.SIGINT,
        signal.SIGTERM,
        *HANGS_UP,
    ):  # `kill` ends a run as Ctrl-C does, also one that a script has put aside
        signal.signal(number, signal.default_int_handler)
    try:
        app(_with_speed(sys.argv[1:] if arguments is None else arguments), standalone_mode=True)
    except VcmvspError as error:
        _say(f"vcmvsp: {' '.join(str(error).splitlines())}")
        _point_to_result(error)
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:
        _say("vcmvsp: interrupted")
        raise SystemExit(Interrupted.exit_code) from None
    except BrokenPipeError:  # the reader of our output has left, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None


def _with_speed(arguments: list[str]) -> list[str]:
    """``--realtime`` alone means ``--realtime 1``."""
    full: list[str] = []
    ours = arguments.index("--") if "--" in arguments else len(arguments)  # what follows is another program's
    for position, argument in enumerate(arguments[:ours]):
        full.append(argument)
        if argument == "--realtime":
            following = arguments[position + 1] if position + 1 < len(arguments) else "--"
            try:
                float(following)
            except ValueError:
                full.append("1")
    return [*full, *arguments[ours:]]


def _checked(scenario: str, settings: dict[str, Any]) -> dict[str, Any]:
    """The resolved scenario, after its federates have been started and closed once."""
    from vcmvsp.cosim.runs import api

    with stdout_to_stderr():
        return api.check(scenario, set=settings)


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def _point_to_result(error: VcmvspError) -> None:
    if error.result is not None:
        _say(f"vcmvsp: what was recorded until then is in {error.result.folder}")


if __name__ == "__main__":
    main()
