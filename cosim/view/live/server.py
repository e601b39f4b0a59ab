"""The viewer process: a guarded web server with the control station, fed through a pipe by its run.

Drawing uses another core than the run. The process ends with the pipe, and so with the run's process, also if that is killed.
"""

import os
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import NoReturn

from vcmvsp.cosim.errors import VcmvspError
from vcmvsp.cosim.util import codec
from vcmvsp.cosim.util.text import plain
from vcmvsp.cosim.view import web_server
from vcmvsp.cosim.view.live import protocol
from vcmvsp.cosim.view.messages import Order

GIVES_WAY = 5  # niceness of the process: the run has priority where cores are few
LAST_S = 1.0  # time to send the end of the run to pages
ORDER_S = 1.0  # time for the run to take an order before it is dropped


def main() -> NoReturn:
    """Show the run at the other end of the inherited socket, whose number is the argument."""
    os.nice(GIVES_WAY)
    pipe = protocol.Pipe(socket.socket(fileno=int(sys.argv[1])))
    code = 0
    try:
        _serve(pipe)
    except VcmvspError as error:
        _say_down(pipe, str(error))
        code = error.exit_code
    except Exception as error:
        traceback.print_exc()
        _say_down(pipe, f"{type(error).__name__}: {error}")
        code = 1
    sys.stderr.flush()
    os._exit(code)  # threads of the web server may still wait for their pages


def pump(pipe: protocol.Pipe, show: Callable[..., None]) -> None:
    """Show incoming updates, all available ones at once, until the pipe closes."""
    while pipe.open:
        if messages := pipe.take(wait_s=None):
            show(*map(protocol.shows.decode, messages))


def _serve(pipe: protocol.Pipe) -> None:
    from vcmvsp.cosim.view.page.control_station import Station

    start = _start(pipe)
    if start is None:
        return
    server = web_server.open_server(start.host, start.port, start.token)
    lock = threading.Lock()

    def order(command: Order | protocol.Up) -> None:  # called by threads of the web server
        with lock:
            pipe.offer_within(codec.encode(command), ORDER_S)

    station = Station(server, start.scenery, order)
    order(protocol.Up(port=server.get_port()))
    pump(pipe, station.show)
    station.draw(texts=True)
    if server.get_clients():
        time.sleep(LAST_S)


def _start(pipe: protocol.Pipe) -> protocol.Start | None:
    """The scenery to show; None: the run is over already."""
    while pipe.open:
        if messages := pipe.take(wait_s=None):
            return protocol.starts.decode(messages[0])
    return None


def _say_down(pipe: protocol.Pipe, problem: str) -> None:
    pipe.offer_within(codec.encode(protocol.Down(problem=plain(problem))), ORDER_S)
