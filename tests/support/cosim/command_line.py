"""The command line, called in this process: exit code and output of a command."""

import contextlib
import io
from pathlib import Path
from typing import NamedTuple

from vcmvsp.cosim.cli.app import main


class Outcome(NamedTuple):
    """Exit code and output of a command."""

    code: int | str | None
    out: str
    err: str


def vcmvsp_command(*arguments: str) -> Outcome:
    """Run one command. An exception other than `SystemExit` would be a traceback on a terminal, and is raised."""
    out, err, code = io.StringIO(), io.StringIO(), None
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(list(arguments))
        except SystemExit as end:
            code = end.code
    return Outcome(code or 0, out.getvalue(), err.getvalue())


def answer_of(*arguments: str) -> str:
    """What a command prints that succeeds, with nothing on stderr."""
    code, out, err = vcmvsp_command(*arguments)
    assert (code, err) == (0, "")
    return out


def assert_refused(outcome: Outcome, *words: str) -> None:
    """A command has failed with exit code 2 and one line with these words on stderr, and nothing on stdout."""
    assert (outcome.code, outcome.out, outcome.err.count("\n")) == (2, "", 1), outcome
    assert outcome.err.startswith("vcmvsp: "), outcome.err
    assert [word for word in words if word not in outcome.err] == [], outcome.err


def contents(folder: Path) -> dict[str, bytes]:
    """Content that is equal for two equal runs: all files but ``about.json`` and the page's section on the machine."""
    paths = [path for path in sorted(folder.iterdir()) if path.name not in ("about.json", "__pycache__")]
    files = {path.name: path.read_bytes() for path in paths}
    if "report.html" in files:
        files["report.html"], _, machine = files["report.html"].partition(b"<h2>Machine</h2>")
        assert machine.count(b"<h2>") == 0  # it is the last section
    return files


def two_cars(
    *,
    top: str = "",
    physics: str = "",
    agents: str = "",
    car1: str = "",
    car2: str = "",
    agent: str | None = None,
    tail: str = "",
) -> str:
    """A short kinematic scenario of a leader and a follower, with lines that a test adds.

    Args:
        top: lines before the tables.
        physics: lines in ``[physics]``.
        agents: lines in ``[agents]``.
        car1: lines in the leader's table.
        car2: lines in the follower's table.
        agent: the follower's ``agent`` table, instead of following.
        tail: lines after everything.
    """
    agent = 'kind = "leader_follower", leader = "car1"' if agent is None else agent
    return f"""
name = "two-cars"
duration_s = 0.5
{top}
[physics]
kind = "kinematic"
{physics}
[agents]
{agents}
[[vehicle]]
name = "car1"
kind = "p2dx"
agent = {{ kind = "trajectory", path = "circle" }}
{car1}
[[vehicle]]
name = "car2"
kind = "p2dx"
pose = [-1.0, -0.5, 0.0]
agent = {{ {agent} }}
{car2}
{tail}
"""
