"""Runs with lock-step programs: threads of the test, or raw bytes on a connection."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import vcmvsp
from vcmvsp.cosim.runs.result import Result
from vcmvsp.cosim.sockets import Socket, connect
from vcmvsp.cosim.sockets.messages import MOST_DOWN, VERSION, Hello, Stream

Play = Callable[[Socket], object]
PATIENCE_S = 60.0


def scenario(path: Path, *names: str, duration_s: float = 1.0, **tables: Any) -> dict[str, Any]:
    """Vehicles at rest, 10 m apart, with a program each; messages take 1 us and less, unless ``radio`` says otherwise."""
    return {
        "name": "programs",
        "duration_s": duration_s,
        "physics": {"kind": "kinematic"},
        "radio": {"preset": "ideal", **tables.pop("radio", {})},
        "sockets": {
            "vehicles": list(names),
            "listen": f"unix/{path}/s",
            "join_timeout_s": PATIENCE_S,
            **tables.pop("sockets", {}),
        },
        "vehicle": [{"name": name, "kind": "kinematic", "pose": [10.0 * i, 0.0, 0.0]} for i, name in enumerate(names)],
        **tables,
    }


def run_programs(content: Mapping[str, Any], plays: Mapping[str, Play], **options: Any) -> Result:
    """Run a scenario with these programs; an exception of one of them is raised here."""
    endpoint, problems = content["sockets"]["listen"], list[BaseException]()

    def go(vehicle: str, play: Play) -> None:
        try:
            with connect(vehicle, endpoint, timeout_s=PATIENCE_S) as end:
                play(end)
        except BaseException as error:
            problems.append(error)

    threads = [threading.Thread(target=go, args=each, daemon=True) for each in plays.items()]
    for thread in threads:
        thread.start()
    try:
        return vcmvsp.run(content, **options)
    finally:
        for thread in threads:
            thread.join(PATIENCE_S)
        if problems:
            raise problems[0]


@contextlib.contextmanager
def open_connection(path: Path) -> Iterator[socket.socket]:
    """A bare connection to a run, opened as soon as it listens."""
    until = time.monotonic() + PATIENCE_S
    with socket.socket(socket.AF_UNIX) as end:
        end.settimeout(PATIENCE_S)
        while True:
            try:
                end.connect(f"{path}/s")
                break
            except OSError:
                if time.monotonic() > until:
                    raise
            time.sleep(0.01)
        yield end


@contextlib.contextmanager
def by_hand(path: Path, vehicle: str) -> Iterator[socket.socket]:
    """A connection on which a program has its first turn."""
    with open_connection(path) as end:
        stream = Stream(end, MOST_DOWN)
        stream.send(Hello(VERSION, vehicle))
        stream.receive()  # it is accepted
        stream.receive()  # and may continue
        with contextlib.suppress(ConnectionError):
            yield end


def idle(end: Socket) -> None:
    """A program that only takes its turns."""
    for _ in end:
        pass


def chat(end: Socket) -> None:
    """A program that broadcasts ten times a second."""
    while True:
        end.sendto(b"here")
        end.sleep(0.1)
