"""Commands in processes of their own: answer, CPU time and memory of each.

As a program: the commands, one per argument; one line of JSON for all. Each is a fork of this process, which has imported
their modules once. ``view`` does not serve its page, which has no end; its first and last state are computed. Runs draw no
figures.
"""

import contextlib
import gc
import importlib
import io
import json
import os
import resource
import shlex
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Sequence
from typing import NamedTuple

from vcmvsp.cosim.view.messages import Seek
from vcmvsp.cosim.view.player.recording import Player, Recording

SHARED = (
    "vcmvsp.cosim.cli.app",
    *("vcmvsp.cosim.runs.api", "vcmvsp.cosim.report.run_page", "vcmvsp.cosim.plots.run_plots", "vcmvsp.cosim.plots.style"),
    *("vcmvsp.cosim.analysis.links", "vcmvsp.cosim.export.formats", "vcmvsp.cosim.studies.outputs"),
    *("vcmvsp.cosim.cli.outputs", "vcmvsp.cosim.view.player.recording", "vcmvsp.cosim.runs.replay"),
    *("vcmvsp.cosim.export.csv_files", "vcmvsp.cosim.export.video", "vcmvsp.cosim.export.rosbag"),
    *("vcmvsp.cosim.export.foxglove_layout", "vcmvsp.cosim.analysis.coverage", "vcmvsp.cosim.analysis.link_budget"),
    *("pydantic.type_adapter", "pandas", "cv2", "av", "matplotlib.style"),
)
"""Modules that the readers of results import, some of them by typer and pyarrow."""
CPU_S, MOST_BYTES = 10, 1 << 30


class CommandCost(NamedTuple):
    """Answer and cost of a command."""

    code: int
    err: str
    cpu_s: float
    bytes: int


def assert_answered(answer: CommandCost) -> None:
    """The command gave a result or one clear line, at little cost."""
    assert answer.code in (0, 2), answer
    assert "Traceback" not in answer.err, answer.err
    assert answer.cpu_s < CPU_S, answer
    assert answer.bytes < MOST_BYTES, answer


def measure_commands(commands: Sequence[str]) -> list[CommandCost]:
    """Run each command; the system ends those that take more than `CPU_S`."""
    line = [sys.executable, "-m", "tests.support.cosim.measured_commands", *commands]
    result = subprocess.run(line, stdout=subprocess.PIPE, check=True, text=True)
    return [CommandCost(*each) for each in json.loads(result.stdout)]


def _run(command: str) -> CommandCost:
    with tempfile.TemporaryFile() as error_output:
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_CPU, (CPU_S + 1, CPU_S + 1))
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(error_output.fileno(), 2)
            os._exit(_code_of(shlex.split(command)))
        _, status, used = os.wait4(child, 0)
        error_output.seek(0)
        err = error_output.read().decode()
    return CommandCost(os.waitstatus_to_exitcode(status), err, used.ru_utime + used.ru_stime, 1024 * used.ru_maxrss)


def _code_of(words: list[str]) -> int:
    """Exit code of a command. Its process then ends without freeing all objects, which would copy them."""
    code: int | str | None = 0
    try:
        sys.modules["vcmvsp.cosim.cli.app"].main(words)
    except SystemExit as end:
        code = end.code or 0
    except BaseException:  # would be a traceback on a terminal
        traceback.print_exc()
        code = 1
    sys.stderr.flush()
    return code if isinstance(code, int) else 1


def _show(player: Player, recording: Recording, *_: object, **__: object) -> None:
    player.show()
    player.order(Seek(time_ns=recording.end_ns))
    player.show()


if __name__ == "__main__":
    for _name in SHARED:
        importlib.import_module(_name)
    with contextlib.redirect_stdout(io.StringIO()):
        _code_of(["list", "scenarios"])  # makes all commands of Click once
    gc.freeze()  # a collection in a forked process would copy all objects that it visits
    sys.modules["vcmvsp.cosim.cli.outputs"]._serve = _show  # type: ignore[attr-defined]
    os.environ["VCMVSP_FIGURES"] = "0"
    sys.stdout.write(json.dumps([_run(each) for each in sys.argv[1:]]))
