"""``vcmvsp view``: a recorded run in the browser."""

import contextlib
import json as jsons
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson, Trust, say
from vcmvsp.cosim.errors import Interrupted
from vcmvsp.cosim.view import HOST, PORT

if TYPE_CHECKING:
    from vcmvsp.cosim.view.player.playback import Player
    from vcmvsp.cosim.view.player.recording import Recording

PERIOD_S = 1.0 / 30.0  # between two pictures


def view_command(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A folder that 'vcmvsp run' has left, or still writes.")],
    port: Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="Where the page is; 0: any that is free.")] = PORT,
    host: Annotated[str, typer.Option(metavar="HOST", help="Address of this machine on which it is.")] = HOST,
    json: AsJson = False,
    trust: Trust = False,
) -> None:
    """Show a recorded run in the browser: open the URL that is printed. Ctrl-C ends it.

    What was recorded can be played, stopped and sought through; the run is not made again.

    Example: vcmvsp view runs/formation-circle-1
    """
    from vcmvsp.cosim.view.player.playback import Player
    from vcmvsp.cosim.view.player.recording import Recording

    try:
        with contextlib.closing(Recording(run_dir, trust)) as recording:
            for trouble in recording.troubles:
                say(f"{run_dir}: {trouble}")
            _serve(Player(recording), recording, host, port, as_json=json)
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None


def _serve(player: "Player", recording: "Recording", host: str, port: int, *, as_json: bool) -> None:
    """Show it until Ctrl-C, which is a good end only once the page is there; it goes on as soon as somebody looks."""
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
