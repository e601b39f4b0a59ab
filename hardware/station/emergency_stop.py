"""Any terminal of this machine can stop the robots that are driven on it, whatever the run does that drives them.

Each station listens on a Unix datagram socket of its own, ``<pid>-<vehicle>.sock``, in a folder that belongs to its user
alone. A datagram is a verb: ``stop``, ``who`` (both are answered) or ``alive``, the operator's heartbeat, which is not. The
answer is an `StationAnswer` in JSON, to the address from which the question came.
"""

import contextlib
import os
import re
import socket
import stat
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple, Self

import msgspec

from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.drivers.base import DriverError

Verb = Literal["stop", "alive", "who"]

LONGEST_NAME = 40  # characters of a vehicle in the name of a file: the address of a socket has 107 in all
LONGEST = 4096  # bytes of a datagram
ANSWER_S = 2.0
_FILE = re.compile(r"(\d+)-([A-Za-z0-9_-]+)\.sock")


class StationAnswer(msgspec.Struct, frozen=True, kw_only=True):
    """What a station says of itself."""

    vehicle: str
    run: str
    pid: int
    state: Literal["driving", "stopped", "silent", "ended"]  # silent: it did not answer; ended: it has gone meanwhile
    cause: str = ""  # why it is stopped


class StationSocket(NamedTuple):
    """A station's socket."""

    path: str
    pid: int
    vehicle: str  # the first `LONGEST_NAME` characters


def folders() -> list[Path]:
    """Where sockets may be: whoever logs in over the network may lack ``XDG_RUNTIME_DIR``, and must find them all the same."""
    user = os.getuid()
    runtime = [os.environ.get("XDG_RUNTIME_DIR", ""), f"/run/user/{user}"]
    places = [Path(each) / "vcmvsp" for each in runtime if each and Path(each).is_dir()]
    return list(dict.fromkeys([*places, Path(f"/tmp/vcmvsp-{user}")]))  # noqa: S108  it is looked at before it is used


def _ours(folder: Path) -> bool:
    """Whether it is a folder that belongs to this user, and that nobody else may enter."""
    try:
        about = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and not about.st_mode & 0o077


class StopListener:
    """The station's side: a socket, and who has said what.

    Raises:
        DriverError: there is no folder for it; a robot that cannot be stopped from elsewhere is not driven.
    """

    def __init__(self, vehicle: str) -> None:
        folder = folders()[0]
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            if not _ours(folder):
                raise PermissionError("it belongs to somebody else, or others may enter it")
            self._path = folder / f"{os.getpid()}-{vehicle[:LONGEST_NAME]}.sock"
            self._path.unlink(missing_ok=True)  # of a station of long ago, with our number
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.bind(str(self._path))
        except OSError as error:
            happened = f"'vcmvsp stop' could not reach it: {folder}: {error.strerror or error}"
            raise DriverError(vehicle, happened, "remove that folder, or set XDG_RUNTIME_DIR to one of your own") from None
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def hear(self) -> list[tuple[str, str | bytes | None]]:
        """Verbs, and where an answer to each belongs; what is no verb is not heard."""
        verbs = []
        with contextlib.suppress(BlockingIOError):
            while True:
                data, address = self._socket.recvfrom(LONGEST)
                if data in (b"stop", b"alive", b"who"):
                    verbs.append((data.decode(), address))
        return verbs

    def answer(self, address: str | bytes | None, answer: StationAnswer) -> None:
        """Tell who asked; never raises, and never waits."""
        if address:
            with contextlib.suppress(OSError):
                self._socket.sendto(msgspec.json.encode(answer), address)

    def close(self) -> None:
        """Nobody is here any more."""
        self._socket.close()
        self._path.unlink(missing_ok=True)


class StopCaller:
    """Speaks to stations; a context manager."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("")  # a name without a file
        self._socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def say(self, verb: Verb, vehicles: Sequence[str] = ()) -> list[StationSocket]:
        """Say it to the stations of these vehicles (none given: of all); which there are.

        What stations that were killed have left behind is removed.
        """
        names, there = [each[:LONGEST_NAME] for each in vehicles], []
        for folder in filter(_ours, folders()):
            for path in sorted(folder.iterdir()):
                name = _FILE.fullmatch(path.name)
                if name and (not names or name[2] in names) and self._say_to(path, verb):
                    there.append(StationSocket(str(path), int(name[1]), name[2]))
        return there

    def _say_to(self, path: Path, verb: Verb) -> bool:
        """Whether somebody is there."""
        try:
            self._socket.sendto(verb.encode(), str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return False
        except OSError:  # it does not read: it hangs, and its robot will be stopped by its own watchdog
            return True
        return True

    def answers(self, sockets: list[StationSocket], wait_s: float = ANSWER_S) -> list[StationAnswer]:
        """The answers, in the order of ``asked``; `silent` or `ended` of those that gave none."""
        answers: dict[str, StationAnswer] = {}
        until = time.monotonic() + wait_s
        open_ = {each.path for each in sockets}
        while open_ and (remaining_s := until - time.monotonic()) > 0.0:
            if readable([self._socket.fileno()], min(remaining_s, 0.1)):
                data, path = self._socket.recvfrom(LONGEST)
                if path in open_:
                    with contextlib.suppress(ValueError):
                        answers[path] = msgspec.json.decode(data, type=StationAnswer)
            open_ = {path for path in open_ if path not in answers and Path(path).exists()}
        return [answers.get(each.path) or _unsaid(each) for each in sockets]


def _unsaid(station: StationSocket) -> StationAnswer:
    state: Literal["silent", "ended"] = "silent" if Path(station.path).exists() else "ended"
    return StationAnswer(vehicle=station.vehicle, run="", pid=station.pid, state=state)
