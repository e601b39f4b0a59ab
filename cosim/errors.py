"""The errors of the platform, as one tree; each message says what, where and what to do.

::

    VcmvspError                 exit code 1
    |-- ScenarioError           2   a scenario file, a key of it or a ``--set``
    |-- UsageError              2   a command-line argument or an output directory
    |-- FederateError           3   a federate failed while the run was going on
    |   `-- AgentError          3   ... an agent: names agent, vehicle and cause
    `-- Interrupted           130   Ctrl-C; the recording so far is complete and readable
"""

import traceback
from pathlib import Path
from typing import Any


def text_of(error: BaseException) -> str:
    """The text of an error; user-defined errors may fail to give one."""
    try:
        return str(error)
    except BaseException:
        return "(its text cannot be read)"


def words_of(error: BaseException) -> str:
    """Type and text of an error, as the middle of a message."""
    return f"{type(error).__name__}: {text_of(error)}"


def place_of(error: BaseException) -> str:
    """Location of an error, as the end of a message: `` (file.py line 12, in act)``; empty if unknown."""
    frames = [each for each in traceback.extract_tb(error.__traceback__)[1:] if "importlib" not in each.filename]
    if not frames or isinstance(error, SyntaxError):  # a syntax error names its own line
        return ""
    inside = "" if frames[-1].name == "<module>" else f", in {frames[-1].name}"
    return f" ({Path(frames[-1].filename).name} line {frames[-1].lineno}{inside})"


class VcmvspError(Exception):
    """Base of all errors that are reported as one message, without a traceback.

    ``result`` holds the recording until then, if the run had begun (a `vcmvsp.Result`).
    """

    exit_code = 1
    result: Any = None


class ScenarioError(VcmvspError):
    """A scenario is invalid.

    ``source`` is the file (or ``--set ...``) and ``key`` the path of the key inside it, such as
    ``radio.loss.probability``; ``problem`` says what is wrong and what is allowed instead.
    """

    exit_code = 2

    def __init__(self, problem: str, *, key: str = "", source: str = "") -> None:
        self.problem, self.key, self.source = problem, key, source
        super().__init__(": ".join(part for part in (source, key, problem) if part))


class UsageError(VcmvspError):
    """An argument of a command or call is invalid."""

    exit_code = 2


class FederateError(VcmvspError):
    """A federate failed during the run; the recording until then is kept."""

    exit_code = 3

    def __init__(self, federate: str, cause: str, *, details: str = "") -> None:
        self.federate, self.cause, self.details = federate, cause, details
        super().__init__(f"{federate}: {cause}")


class AgentError(FederateError):
    """An agent raised an exception, ended, or did not answer in time. ``details`` holds its traceback, if any."""

    def __init__(self, vehicles: tuple[str, ...], agent: str, cause: str, *, details: str = "") -> None:
        self.vehicles, self.agent = vehicles, agent
        plural = "vehicle" if len(vehicles) == 1 else "vehicles"
        super().__init__(f"agent {agent} of {plural} {', '.join(vehicles)}", cause, details=details)


class Interrupted(VcmvspError):
    """The user stopped the run (Ctrl-C)."""

    exit_code = 130
