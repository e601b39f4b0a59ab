"""The command line ``vcmvsp``: all commands, and `main`. Commands only parse: each calls what Python users call.

A module of this package holds the commands of one subject and loads heavy parts inside its functions.
"""

import os
import signal
import sys

import typer

from vcmvsp.cosim.cli.calibrate import calibrate_command, calibrate_recognition_command
from vcmvsp.cosim.cli.doctor import doctor_command
from vcmvsp.cosim.cli.emulate import emulate_app
from vcmvsp.cosim.cli.keys import keys_app
from vcmvsp.cosim.cli.kinds import list_command, reference_command, show_command, world_command
from vcmvsp.cosim.cli.net import net_app
from vcmvsp.cosim.cli.new import new_command
from vcmvsp.cosim.cli.options import DATA, PROGRAM, say
from vcmvsp.cosim.cli.outputs import export_command, plot_command, report_command
from vcmvsp.cosim.cli.radio import channel_command, pathloss_command, per_command, radio_command
from vcmvsp.cosim.cli.remote import agent_command, watch_command
from vcmvsp.cosim.cli.reproduce import bench_command, figure_command, validate_command
from vcmvsp.cosim.cli.robot import operator_command, robot_command, stop_command
from vcmvsp.cosim.cli.run import check_command, drive_command, launch_command, replay_command, run_command
from vcmvsp.cosim.cli.study import study_command
from vcmvsp.cosim.cli.view import view_command
from vcmvsp.cosim.config.messages import show
from vcmvsp.cosim.errors import Interrupted, UsageError, VcmvspError

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

app.command("run", epilog=PROGRAM)(run_command)
app.command("agent")(agent_command)
app.command("check", epilog=PROGRAM)(check_command)
app.command("plot", epilog=DATA)(plot_command)
app.command("doctor")(doctor_command)
app.command("drive", epilog=PROGRAM)(drive_command)
app.command("replay", epilog=PROGRAM)(replay_command)
app.command("export", epilog=DATA)(export_command)
app.command("report", epilog=DATA)(report_command)
app.command("launch", epilog=PROGRAM)(launch_command)
app.command("study", epilog=PROGRAM)(study_command)
app.command("figure")(figure_command)
app.command("validate")(validate_command)
app.command("bench")(bench_command)
app.command("new")(new_command)
app.command("reference")(reference_command)
app.command("list")(list_command)
app.command("show", epilog=PROGRAM)(show_command)
app.command("world", epilog=PROGRAM)(world_command)
app.command("radio", epilog=f"{DATA} {PROGRAM}")(radio_command)
app.command("calibrate", epilog=PROGRAM)(calibrate_command)
app.command("calibrate-recognition", epilog=PROGRAM)(calibrate_recognition_command)
app.command("view", epilog=DATA)(view_command)
app.command("watch")(watch_command)
app.command("channel")(channel_command)
app.command("per")(per_command)
app.command("pathloss")(pathloss_command)
app.command("stop")(stop_command)
app.command("operator")(operator_command)
app.command("robot")(robot_command)
app.add_typer(emulate_app)
app.add_typer(keys_app)
app.add_typer(net_app)


def main(arguments: list[str] | None = None) -> None:
    """Entry point: one message and an exit code for whatever goes wrong."""
    if "_VCMVSP_COMPLETE" in os.environ:  # a shell asks what can stand next
        from vcmvsp.cosim.cli import completion

        completion.answer(app)
    for number in (signal.SIGINT, signal.SIGTERM, *HANGS_UP):  # `kill` ends a run as Ctrl-C does, also one in the background
        signal.signal(number, signal.default_int_handler)
    try:
        app(_with_speed(sys.argv[1:] if arguments is None else arguments), standalone_mode=True)
    except VcmvspError as error:
        say(f"vcmvsp: {' '.join(str(error).splitlines())}")
        if error.result is not None:
            say(f"vcmvsp: what was recorded until then is in {error.result.folder}")
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:
        say("vcmvsp: interrupted")
        raise SystemExit(Interrupted.exit_code) from None
    except BrokenPipeError:  # the reader of our output has left, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:  # a name that is too long, a folder that cannot be read, a disk that is full
        if error.filename is None:
            raise
        say(f"vcmvsp: {show(str(error.filename))}: {error.strerror}")
        raise SystemExit(UsageError.exit_code) from None


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


if __name__ == "__main__":
    main()
