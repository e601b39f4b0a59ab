"""The viewer's own process: a guarded web server, and the station on it, fed through a pipe by the run that started it.

Whatever it costs to draw costs the run nothing but the other core. It ends when the pipe does: with the run's process, however
that ends.
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

GIVES_WAY = 5  # to the run, where cores are few: the niceness of a process
LAST_S = 0.2  # for pages to be sent how it ended
ORDER_S = 1.0  # for the run to take an order, before it is given up


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
    """Show what comes, all at once that has come meanwhile, until nothing comes any more."""
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

    def order(wanted: Order | protocol.Up) -> None:  # from the threads of the web server
        with lock:
            pipe.offer_within(codec.encode(wanted), ORDER_S)

    station = Station(server, start.scenery, order)
    order(protocol.Up(port=server.get_port()))
    pump(pipe, station.show)
    time.sleep(LAST_S)


def _start(pipe: protocol.Pipe) -> protocol.Start | None:
    """What is to be shown; None: the run is over already."""
    while pipe.open:
        if messages := pipe.take(wait_s=None):
            return protocol.starts.decode(messages[0])
    return None


def _say_down(pipe: protocol.Pipe, problem: str) -> None:
    pipe.offer_within(codec.encode(protocol.Down(problem=plain(problem))), ORDER_S)
