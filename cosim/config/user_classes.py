"""Kinds that name a module or a Python file (``module:Class``, ``file.py:Class``), and which of them may be loaded."""

import contextlib
import contextvars
import re
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import ModuleType

from vcmvsp.cosim.errors import ScenarioError

_MODULE_KIND = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def classes_in(value: object) -> list[str]:
    """All ``module:Class`` and ``file.py:Class`` among the strings of a value, as TOML has it."""
    if isinstance(value, str):
        return [value] if is_file_kind(value) or _MODULE_KIND.fullmatch(value) else []
    if not isinstance(value, Mapping | list | tuple):
        return []
    inside = value.values() if isinstance(value, Mapping) else value
    return list(dict.fromkeys(found for each in inside for found in classes_in(each)))


def host_options(tables: object, folder: str) -> list[str]:
    """The options with which ``vcmvsp agent`` lets a run ask for the classes that these tables name.

    Args:
        tables: of the agents.
        folder: where their Python files are on the host's machine.
    """
    classes = classes_in(tables)
    options = [f"--allow={kind}" for kind in classes if not is_file_kind(kind)]
    return options if len(options) == len(classes) else [f"--folder={folder}", *options]


def is_file_kind(kind: str) -> bool:
    """Whether a kind names a file rather than a module or a short name."""
    return kind.rpartition(":")[0].endswith(".py")


class OwnCode:
    """The classes that may be loaded beside those that are built in or, but for `NO_CODE`, installed under a short name.

    Args:
        kinds: ``module:Class`` or ``file.py:Class``, as they stand on the host's command line.
        folder: of Python files that a run may ask for by file name; None: none.
        tell: takes a line for the user about each class that is loaded.
    """

    def __init__(self, kinds: Collection[str], folder: Path | None, tell: Callable[[str], None] = lambda _: None) -> None:
        self._kinds, self._folder, self._tell = frozenset(kinds), folder, tell

    def file_of(self, kind: str) -> Path | None:
        """Where the file of this kind is on this machine; None: it is a module's.

        Raises:
            ScenarioError: the user has not allowed this class.
        """
        if self is NO_CODE:
            raise ScenarioError(f"'{kind}' is not built in, and reading results executes nothing of theirs; --trust does")
        if ":" not in kind:
            return None
        known, own = kind in self._kinds, Path(kind.rpartition(":")[0])
        if not is_file_kind(kind):
            if not known:
                raise ScenarioError(f"the run asks for '{kind}', which this host's command line does not allow: --allow {kind}")
            return None
        if known and (own.is_file() or self._folder is None):
            return own.resolve()
        if self._folder is None:
            raise ScenarioError(
                f"the run asks for '{kind}', and this host has no folder of files to run: --folder DIR with {own.name}"
            )
        return (self._folder / own.name).resolve()

    def took(self, kind: str, module: ModuleType) -> None:
        """Tell the user which file a class comes from."""
        self._tell(f"{kind.rpartition(':')[2]} comes from {module.__file__}")


NO_CODE = OwnCode((), None)
"""None but the built-in classes: results are read."""
allowed_code: contextvars.ContextVar[OwnCode | None] = contextvars.ContextVar("allowed_code", default=None)


@contextlib.contextmanager
def only(code: OwnCode | None) -> Iterator[None]:
    """While a host answers a run, or results are read: load these classes alone; None: whatever may be loaded now."""
    token = allowed_code.set(code or allowed_code.get())
    try:
        yield
    finally:
        allowed_code.reset(token)
