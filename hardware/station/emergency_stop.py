"""Emergency stop: any terminal of this machine can stop the robots that it drives, independently of their runs.

Each station listens on a Unix datagram socket, ``<pid>-<vehicle>.sock``, in a folder of its user. A datagram is a verb:
``stop``, ``who`` (both are answered) or ``alive``, the operator's heartbeat. The answer is a `StationAnswer` in JSON, to the
sender's address.
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
    """State of a station."""

    vehicle: str
    run: str
    pid: int
    state: Literal["driving", "stopped", "silent", "ended"]  # silent: no answer; ended: the station ended meanwhile
    cause: str = ""  # why it is stopped


class StationSocket(NamedTuple):
    """Socket of a station."""

    path: str
    pid: int
    vehicle: str  # the first `LONGEST_NAME` characters


def folders() -> list[Path]:
    """Folders that may hold sockets; a remote login may lack ``XDG_RUNTIME_DIR``."""
    user = os.getuid()
    runtime = [os.environ.get("XDG_RUNTIME_DIR", ""), f"/run/user/{user}"]
    places = [Path(each) / "vcmvsp" for each in runtime if each and Path(each).is_dir()]
    return list(dict.fromkeys([*places, Path(f"/tmp/vcmvsp-{user}")]))  # noqa: S108  it is looked at before it is used


def _ours(folder: Path) -> bool:
    try:
        about = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(about.st_mode) and about.st_uid == os.getuid() and not about.st_mode & 0o077


class StopListener:
    """Socket of a station; `DriverError`: there is no folder for it; a robot without emergency stop is not driven."""

    def __init__(self, vehicle: str) -> None:
        folder = folders()[0]
        try:
            folder.mkdir(mode=0o700, exist_ok=True)
            if not _ours(folder):
                raise PermissionError("it belongs to another user, or others may enter it")
            self._path = folder / f"{os.getpid()}-{vehicle[:LONGEST_NAME]}.sock"
            self._path.unlink(missing_ok=True)  # of an ended process with the same number
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.bind(str(self._path))
        except OSError as error:
            happened = f"'vcmvsp stop' could not reach it: {folder}: {error.strerror or error}"
            raise DriverError(vehicle, happened, "remove that folder, or set XDG_RUNTIME_DIR to your own folder") from None
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """For select."""
        return self._socket.fileno()

    def hear(self) -> list[tuple[str, str | bytes | None]]:
        """Verbs and the addresses for answers; other datagrams are ignored."""
        verbs = []
        with contextlib.suppress(BlockingIOError):
            while True:
                data, address = self._socket.recvfrom(LONGEST)
                if data in (b"stop", b"alive", b"who"):
                    verbs.append((data.decode(), address))
        return verbs

    def answer(self, address: str | bytes | None, answer: StationAnswer) -> None:
        """Answer an address; never raises, and never waits."""
        if address:
            with contextlib.suppress(OSError):
                self._socket.sendto(msgspec.json.encode(answer), address)

    def close(self) -> None:
        """Remove the socket."""
        self._socket.close()
        self._path.unlink(missing_ok=True)


class StopCaller:
    """Sends verbs to stations; a context manager."""

    def __init__(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind("")  # a name without a file
        self._socket.setblocking(False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def say(self, verb: Verb, vehicles: Sequence[str] = ()) -> list[StationSocket]:
        """Send a verb to the stations of these vehicles (empty: all); the stations that exist.

        Sockets of killed stations are removed.
        """
        names, stations = [each[:LONGEST_NAME] for each in vehicles], []
        for folder in filter(_ours, folders()):
            for path in sorted(folder.iterdir()):
                name = _FILE.fullmatch(path.name)
                if name and (not names or name[2] in names) and self._say_to(path, verb):
                    stations.append(StationSocket(str(path), int(name[1]), name[2]))
        return stations

    def _say_to(self, path: Path, verb: Verb) -> bool:
        try:
            self._socket.sendto(verb.encode(), str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return False
        except OSError:  # it hangs; its robot's watchdog stops the robot
            return True
        return True

    def answers(self, sockets: list[StationSocket], wait_s: float = ANSWER_S) -> list[StationAnswer]:
        """Answers in the order of ``sockets``; state `silent` or `ended` without an answer."""
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
        for each in sockets:
            state: Literal["silent", "ended"] = "silent" if Path(each.path).exists() else "ended"
            unsaid = StationAnswer(vehicle=each.vehicle, run="", pid=each.pid, state=state)
            answers.setdefault(each.path, unsaid)
        return [answers[each.path] for each in sockets]
