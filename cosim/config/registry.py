"""From the ``kind`` of a scenario to a class: a short name (`cosim.config.builtin_kinds`), ``module:Class``, ``file.py:Class``.

A kind is imported when a scenario names it, so that ``import vcmvsp`` stays light. Other distributions add short
names through the entry-point groups ``vcmvsp.<group>``, e.g. ``vcmvsp.agent``.
"""

import contextlib
import contextvars
import hashlib
import importlib
import importlib.machinery
import importlib.metadata
import importlib.util
import os
import platform
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from vcmvsp.cosim.config.binding import Named, Origin
from vcmvsp.cosim.config.builtin_kinds import KINDS, NOTHING, VERBS
from vcmvsp.cosim.config.messages import show, unknown
from vcmvsp.cosim.config.user_classes import NO_CODE, allowed_code, is_file_kind
from vcmvsp.cosim.errors import ScenarioError, place_of, words_of

_folder: contextvars.ContextVar[Path | None] = contextvars.ContextVar("folder", default=None)


SHIPPED = Path(__file__).resolve().parents[2] / "scenarios"
"""The built-in scenarios, and the files that come with them."""


def located(name: str, folder: Path | None = None) -> Path:
    """Where a file is that a scenario names: beside it, or else among those that come with the built-in scenarios.

    Args:
        name: as it is written.
        folder: the scenario's; default: that of `looking_in`, or the current one.
    """
    folder = folder or _folder.get() or Path()
    is_shipped = os.path.realpath(folder) == str(SHIPPED)
    places = (SHIPPED, Path()) if is_shipped else (folder, SHIPPED)  # what a built-in scenario has not, --set has named
    try:
        first, second = (Path(os.path.realpath(each / name)) for each in places)
        return first if first.exists() or not (is_shipped or second.is_file()) else second
    except (OSError, ValueError) as error:  # too long for the system, or with a zero in it
        raise ScenarioError(f"{show(name)} cannot be the name of a file") from error


@contextlib.contextmanager
def looking_in(folder: Path) -> Iterator[None]:
    """While something is built: where the files are that it names itself, in its parameters."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


def may_import(group: str, kind: object) -> bool:
    """Whether `find` imports the class of a kind: that of a built-in one always, any other unless results are read."""
    return allowed_code.get() is not NO_CODE or (isinstance(kind, str) and kind in KINDS[group])


def find(group: str, kind: str, *, folder: Path | None = None, key: str = "kind", origin: Origin | None = None) -> Any:
    """The class that ``kind`` names.

    Args:
        group: what it is looked up as, e.g. ``"agent"``.
        kind: short name, ``module:Class`` or ``file.py:Class``.
        folder: where a relative file is looked for (the scenario's folder); default: that of `looking_in`, or the current one.
        key: path of the kind in the scenario, for messages.
        origin: where the scenario came from, for messages.

    Raises:
        ScenarioError: there is no such kind, what it names cannot be imported, or may not be (`user_classes.only`).
    """
    origin = origin or Named()
    aim = target(group, kind, key=key, origin=origin)
    where, _, name = aim.rpartition(":")
    is_own = kind not in KINDS[group]
    try:
        path = file_of(kind, folder) if is_own else None
    except ScenarioError as error:
        raise ScenarioError(error.problem, key=key, source=origin.of(key)) from error
    if path and not path.is_file():
        raise ScenarioError(f"there is no file {path} on {platform.node()}", key=key, source=origin.of(key))
    try:
        module = load_file(path) if path else importlib.import_module(where)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # whatever somebody's own module raises
        problem = f"'{where}' cannot be imported: {words_of(error)}{place_of(error)}"
        raise ScenarioError(problem, key=key, source=origin.of(key)) from error
    if is_own and (code := allowed_code.get()):
        code.took(kind, module)
    found = getattr(module, name, None)
    if found is None:
        raise ScenarioError(f"'{where}' has no class '{name}'", key=key, source=origin.of(key))
    lacking = [verb for verb in re.findall(r"\w+(?:\(.*?\))?", VERBS[group]) if not hasattr(found, verb.partition("(")[0])]
    if aim != NOTHING and (lacking or not callable(found)):
        problem = f"'{kind}' is no {group.replace('_', '-')}: it has no {', '.join(lacking) or VERBS[group]}"
        raise ScenarioError(problem, key=key, source=origin.of(key))
    return found


def target(group: str, kind: str, *, key: str = "kind", origin: Origin | None = None) -> str:
    """``module:Class`` or ``file.py:Class`` of a kind that may be a short name."""
    if ":" in kind:
        return kind
    if kind in KINDS[group]:
        return KINDS[group][kind]
    others = _entry_points(group)  # looks through all installed distributions: only where it must
    if kind not in others:
        names = [*KINDS[group], *others]
        problem = unknown(f"{group.replace('_', '-')} kind", kind, names) + "; or give module:Class or file.py:Class"
        raise ScenarioError(problem, key=key, source=(origin or Named()).of(key))
    return others[kind]


def file_of(kind: str, folder: Path | None) -> Path | None:
    """The Python file of a kind that is not built in, if that may be loaded; None: it is no file's.

    Raises:
        ScenarioError: the kind may not be loaded (`user_classes.only`).
    """
    if code := allowed_code.get():
        return code.file_of(kind)
    return located(kind.rpartition(":")[0], folder) if is_file_kind(kind) else None


def load_file(path: Path) -> ModuleType:
    """Import a Python file by its path, afresh; modules beside it can be imported by it."""
    name = f"_vcmvsp_{path.stem}_{hashlib.blake2b(str(path).encode(), digest_size=6).hexdigest()}"
    loader = importlib.machinery.SourceFileLoader(name, str(path))
    spec = importlib.machinery.ModuleSpec(name, loader, origin=str(path))
    spec.has_location = True  # so that the module has a __file__, by which its source is found
    module = importlib.util.module_from_spec(spec)
    before = {*sys.modules, name}
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent))
    try:
        loader.exec_module(module)
    finally:
        sys.path.remove(str(path.parent))
        for other in [each for each in sys.modules if each not in before and _lies_in(sys.modules[each], path.parent)]:
            del sys.modules[other]  # what it imported from beside it is its own, and is read afresh next time
    return module


def _lies_in(module: ModuleType, folder: Path) -> bool:
    file = getattr(module, "__file__", None)
    return file is not None and Path(file).resolve().is_relative_to(folder)


def _entry_points(group: str) -> dict[str, str]:
    return {entry.name: entry.value for entry in importlib.metadata.entry_points(group=f"vcmvsp.{group}")}
