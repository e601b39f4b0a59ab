"""``vcmvsp plot``, ``report``, ``export`` and ``view``: figures, reports, exports and playback of a recorded run."""

import contextlib
import json as jsons
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson, Trust, say
from vcmvsp.cosim.cli.run import Quiet
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.terminal.progress import StatusDisplay
from vcmvsp.cosim.view import HOST, PORT

if TYPE_CHECKING:
    from vcmvsp.cosim.view.player.recording import Player, Recording


RunDir = Annotated[Path, typer.Argument(metavar="RUN_DIR", help="Folder of a run.")]


def plot_command(
    run_dirs: Annotated[list[Path], typer.Argument(metavar="RUN_DIR...", help="Folder of a run; several are compared.")],
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the figures [the first RUN_DIR].")] = None,
    svg: Annotated[bool, typer.Option("--svg", help="Write SVG instead of PNG.")] = False,
    pdf: Annotated[bool, typer.Option("--pdf", help="Write PDF instead of PNG, with --svg both.")] = False,
    trust: Trust = False,
) -> None:
    """Draw the figures of a run again, or several runs side by side; also of a killed run, up to the end of its recording.

    Example: vcmvsp plot runs/formation-circle-1 runs/formation-slalom-1 --out both
    """
    from vcmvsp.cosim.runs import api

    kinds = [kind for kind, is_on in (("svg", svg), ("pdf", pdf)) if is_on] or ["png"]
    for path in api.plot(run_dirs, out or run_dirs[0], kinds=kinds, tell=say, trust=trust):
        sys.stdout.write(f"{path}\n")


def report_command(
    folder: Annotated[Path, typer.Argument(metavar="RUN_OR_STUDY_DIR", help="Folder of a run or study.")],
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="File for the page [report.html in that folder].")] = None,
    trust: Trust = False,
) -> None:
    """Make report.html of a run or study again: figures, numbers, losses with causes, commands to repeat it.

    For a killed run or an unfinished study it shows the available data and lists what is missing.

    Example: vcmvsp report runs/formation-circle-1
    """
    from vcmvsp.cosim.studies import outputs
    from vcmvsp.cosim.studies.store import PLAN
    from vcmvsp.cosim.util.files import writing

    if not folder.is_dir():
        raise UsageError(
            f"{folder}: {'is not a folder' if folder.exists() else 'does not exist'}; name the folder of a run or a study"
        )
    if out is not None and out.is_dir():
        raise UsageError(f"--out {out}: is a folder; give a file name, e.g. {out / 'report.html'}")
    with writing(out or folder):
        path = outputs.report_again(folder, out) if (folder / PLAN).is_file() else _of_run(folder, out, trust=trust)
    sys.stdout.write(f"{path}\n")


def export_command(
    run_dir: RunDir,
    rosbag2: Annotated[bool, typer.Option("--rosbag2", help="rosbag2/: a ROS 2 bag, MCAP inside.")] = False,
    csv: Annotated[bool, typer.Option("--csv", help="csv/: states, errors, notes, radio, commands and sensors.")] = False,
    mp4: Annotated[bool, typer.Option("--mp4", help="run.mp4: a film of the run from above.")] = False,
    layout: Annotated[
        bool, typer.Option("--layout", help="layout.json: a Foxglove and Lichtblick layout for its run.mcap.")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the exports [RUN_DIR].")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    quiet: Quiet = False,
) -> None:
    """Convert the recording of a run to formats of other tools; also of a killed run, up to its end.

    Example: vcmvsp export runs/formation-circle-1 --csv --mp4
    """
    from vcmvsp.cosim.export.formats import NAMES, export

    formats = {"rosbag2": rosbag2, "csv": csv, "mp4": mp4, "layout": layout}
    paths = {name: (out or run_dir) / NAMES[name] for name, is_wanted in formats.items() if is_wanted}
    with StatusDisplay(quiet=quiet) as display:

        def on_part(name: str, part: float) -> None:
            display.show(f"{name}: {100 * part:.0f} %", part, 1.0)

        written = export(run_dir, **paths, force=force, tell=display.tell, progress=on_part)
    for path in written:
        sys.stdout.write(f"{path}\n")


def _of_run(folder: Path, out: Path | None, *, trust: bool) -> Path:
    from vcmvsp.cosim.plots.style import svg
    from vcmvsp.cosim.report import run_page
    from vcmvsp.cosim.runs.result import figures_again

    try:
        figures = figures_again(folder, trust=trust)
    except UsageError:  # tables missing or damaged: the page says so
        figures = {}
    return run_page.write(folder, {name: svg(figure) for name, figure in figures.items()}, out)


PERIOD_S = 1.0 / 30.0  # between two updates of the page


def view_command(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="Folder of a run, finished or still running.")],
    port: Annotated[
        int, typer.Option("--view-port", "--port", metavar="PORT", min=0, max=65535, help="Port of the page; 0: any free port.")
    ] = PORT,
    host: Annotated[
        str, typer.Option("--view-host", "--host", metavar="HOST", help="Address of this machine for the page.")
    ] = HOST,
    json: AsJson = False,
    trust: Trust = False,
) -> None:
    """Show a recorded run in the browser: open the printed URL. Ctrl-C ends it.

    The page plays, stops and seeks the recording; the run is not repeated.

    Example: vcmvsp view runs/formation-circle-1
    """
    from vcmvsp.cosim.view.player.recording import Player, Recording

    with contextlib.closing(Recording(run_dir, trust)) as recording:
        for trouble in recording.troubles:
            say(f"{run_dir}: {trouble}")
        _serve(Player(recording), recording, host, port, as_json=json)


def _serve(player: "Player", recording: "Recording", host: str, port: int, *, as_json: bool) -> None:
    """Serve the page until Ctrl-C, which is a success only once the page is up; playback starts with the first viewer."""
    from vcmvsp.cosim.view.messages import Go
    from vcmvsp.cosim.view.page.control_station import Station
    from vcmvsp.cosim.view.web_server import caution, close_server, new_token, open_server, url_of

    token = new_token()
    server = open_server(host, port, token)
    try:
        station = Station(server, recording.scenery, player.order)
        url = url_of(host, server.get_port(), token)
        with contextlib.suppress(KeyboardInterrupt):
            sys.stdout.write(jsons.dumps({"url": url}) + "\n" if as_json else f"{url}\n")
            sys.stdout.flush()
            sys.stderr.write(caution(host))
            station.show(player.show())
            while not server.get_clients():
                time.sleep(PERIOD_S)
            player.order(Go(speed=1.0))
            while True:
                station.show(player.show())
                time.sleep(PERIOD_S)
    finally:
        close_server(server)
