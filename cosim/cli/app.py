"""All commands of ``vcmvsp``, and `main`."""

import atexit
import contextlib
import functools
import gc
import os
import signal
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import typer
import typer.core

from vcmvsp.cosim.cli.emulate import emulate_app
from vcmvsp.cosim.cli.keys import keys_app
from vcmvsp.cosim.cli.kinds import list_command, new_command, reference_command, show_command, world_command
from vcmvsp.cosim.cli.net import net_app
from vcmvsp.cosim.cli.options import DATA, PROGRAM, say
from vcmvsp.cosim.cli.outputs import export_command, plot_command, report_command, view_command
from vcmvsp.cosim.cli.radio import (
    calibrate_command,
    calibrate_recognition_command,
    channel_command,
    pathloss_command,
    per_command,
    radio_command,
)
from vcmvsp.cosim.cli.remote import agent_command, doctor_command, watch_command
from vcmvsp.cosim.cli.reproduce import bench_command, figure_command, validate_command
from vcmvsp.cosim.cli.robot import operator_command, robot_command, stop_command
from vcmvsp.cosim.cli.run import (
    check_command,
    demo_command,
    drive_command,
    launch_command,
    replay_command,
    run_command,
    study_command,
)
from vcmvsp.cosim.config.binding import show
from vcmvsp.cosim.errors import Interrupted, UsageError, VcmvspError
from vcmvsp.cosim.view import FOXGLOVE_PORT

if TYPE_CHECKING:
    from vcmvsp.cosim.runs.figures import Drawer

HANGS_UP = () if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (signal.SIGHUP,)
"""Signals of a closed terminal, handled like Ctrl-C unless ignored, as under nohup."""


class Panels(typer.core.TyperGroup):
    """A command group whose help lists the commands in panels, one per subject."""

    def format_commands(self, ctx: typer.Context, formatter: Any) -> None:  # type: ignore[override]  # click's types are private to typer
        """Write the panels of commands."""
        for panel, commands in PANELS.items():
            with formatter.section(panel):
                formatter.write_dl([(name, self.commands[name].short_help or "") for name in commands])


app = typer.Typer(
    name="vcmvsp",
    cls=Panels,
    help="Simulate many vehicles and the radio between them.\n\nStart with: vcmvsp demo",
    no_args_is_help=True,
    rich_markup_mode=None,  # rich help costs a third of a second at every start
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
# Name, function or group, summary in one line, epilog.
_Command = tuple[str, Callable[..., None] | typer.Typer, str, str | None]
_COMMANDS: dict[str, tuple[_Command, ...]] = {
    "Run": (
        ("run", run_command, "Run a scenario", PROGRAM),
        ("demo", demo_command, "Run a formation with and without losses, and compare", None),
        ("check", check_command, "Check the keys of a scenario without running it", PROGRAM),
        ("study", study_command, "Run a scenario over a grid of values and seeds", PROGRAM),
        ("replay", replay_command, "Repeat a recorded run, changed or unchanged", PROGRAM),
        ("drive", drive_command, "Print the response of a vehicle to one command", PROGRAM),
    ),
    "Look": (
        ("view", view_command, "Replay a recorded run in the browser", DATA),
        ("report", report_command, "Make report.html of a run or study again", DATA),
        ("plot", plot_command, "Make the figures of a run again", DATA),
        ("export", export_command, "Convert a recording: ROS 2 bag, CSV, film, layout", DATA),
    ),
    "Radio": (
        ("radio", radio_command, "Explain losses and link budgets; map coverage", f"{DATA} {PROGRAM}"),
        ("channel", channel_command, "Simulate broadcasts of static radios alone", None),
        ("pathloss", pathloss_command, "Tabulate loss, received power, SNR by distance", None),
        ("per", per_command, "Tabulate packet error rates by SNR", None),
        ("calibrate", calibrate_command, "Fit a channel model to measured levels", PROGRAM),
        ("net", net_app, "Give each vehicle a network namespace (root)", None),
    ),
    "Robots": (
        ("robot", robot_command, "Drive a robot from its own computer", None),
        ("operator", operator_command, "Hold the operator's deadman for real robots", None),
        ("stop", stop_command, "Stop all robots that this machine drives", None),
        ("emulate", emulate_app, "Emulate robots and positioning at a real port", None),
        ("calibrate-recognition", calibrate_recognition_command, "Measure detection and false-alarm rates", PROGRAM),
    ),
    "Machines": (
        ("agent", agent_command, "Host agents for a run on another machine", None),
        ("launch", launch_command, "Run a scenario and start its hosts over ssh", PROGRAM),
        ("watch", watch_command, "Print the topics of a run, here or elsewhere", None),
        ("keys", keys_app, "Make certificates for other machines", None),
        ("doctor", doctor_command, "Check this installation or a connection", None),
    ),
    "Build your own": (
        ("list", list_command, "List scenarios, or kinds of a group", None),
        ("show", show_command, "Print a scenario, or the parameters of a kind", PROGRAM),
        ("reference", reference_command, "Print the keys of a scenario", None),
        ("world", world_command, "Draw a world", PROGRAM),
        ("new", new_command, "Write a template of an agent, sensor or driver", None),
    ),
    "Proof": (
        ("validate", validate_command, "Measure every law and outside reference anew", None),
        ("figure", figure_command, "Make a figure of the thesis and compare it", None),
        ("bench", bench_command, "Measure speed beside other tools", None),
    ),
}


def _interruptible(command: Callable[..., None]) -> Callable[..., None]:
    """The command; Ctrl-C is an error of vcmvsp, with its message and exit code."""

    @functools.wraps(command)
    def call(*positional: object, **keywords: object) -> None:
        try:
            command(*positional, **keywords)
        except KeyboardInterrupt:
            raise Interrupted("interrupted") from None

    return call


PANELS: dict[str, list[str]] = {}
for _panel, _commands in _COMMANDS.items():
    PANELS[_panel] = [name for name, *_ in _commands]
    for _name, _target, _summary, _epilog in _commands:
        if isinstance(_target, typer.Typer):
            app.add_typer(_target, name=_name, short_help=_summary)
        else:
            app.command(_name, short_help=_summary, epilog=_epilog)(_interruptible(_target))


@functools.cache
def command() -> Any:
    """All commands, as an object of Click."""
    return typer.main.get_command(app)


def main(arguments: list[str] | None = None) -> None:
    """Entry point of ``vcmvsp``: reports every error as one message and an exit code."""
    if "_VCMVSP_COMPLETE" in os.environ:  # a shell requests completions
        from vcmvsp.cosim.cli import completion

        completion.answer(app)
    gc.set_threshold(50_000, 20)  # of the many objects of imports, none is in a cycle that ends
    atexit.register(gc.freeze)  # nor does the end of the process look for cycles among them, a tenth of a short run
    _handle_ends(signal.default_int_handler)  # `kill` ends a run as Ctrl-C does, also one in the background
    words = sys.argv[1:] if arguments is None else arguments
    try:
        with drawer_of(words) as drawer:
            command()(_with_values(words), obj=drawer, standalone_mode=True)
    except VcmvspError as error:
        say(f"vcmvsp: {' '.join(str(error).splitlines())}")
        if error.result is not None:
            say(f"vcmvsp: the recording until then is in {error.result.folder}")
        raise SystemExit(error.exit_code) from None
    except KeyboardInterrupt:
        say("vcmvsp: interrupted")
        raise SystemExit(Interrupted.exit_code) from None
    except BrokenPipeError:  # the reader of the output has closed it, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except OSError as error:  # name too long, folder unreadable, disk full
        if error.filename is None:
            raise
        say(f"vcmvsp: {show(str(error.filename))}: {error.strerror}")
        raise SystemExit(UsageError.exit_code) from None
    finally:
        if arguments is None:  # the process ends: a late Ctrl-C ends it at once, without a traceback
            _handle_ends(signal.SIG_DFL)


def drawer_of(arguments: list[str]) -> contextlib.AbstractContextManager["Drawer | None"]:
    """The drawer of a run at its own pace, which imports Matplotlib while this process still parses the command line."""
    if arguments[:1] != ["run"] or {each.partition("=")[0] for each in arguments} & LIVE:
        return contextlib.nullcontext()
    from vcmvsp.cosim.runs.figures import Drawer

    return Drawer()


def _handle_ends(handler: Any) -> None:
    for number in (signal.SIGINT, signal.SIGTERM, *HANGS_UP):
        signal.signal(number, handler)


ALONE = {"--realtime": "1", "--foxglove": str(FOXGLOVE_PORT)}
"""Values of options whose value can be left out."""
LIVE = {*ALONE, "--view"}
"""Options of runs that follow the wall clock."""


def _with_values(arguments: list[str]) -> list[str]:
    """``--realtime`` alone means ``--realtime 1``, ``--foxglove`` alone its usual port."""
    full: list[str] = []
    ours = arguments.index("--") if "--" in arguments else len(arguments)  # arguments after it belong to another program
    for argument, following in zip(arguments[:ours], [*arguments[1:], "--"], strict=False):
        full.append(argument)
        if argument in ALONE:
            try:
                float(following)
            except ValueError:
                full.append(ALONE[argument])
    return [*full, *arguments[ours:]]


if __name__ == "__main__":
    main()
