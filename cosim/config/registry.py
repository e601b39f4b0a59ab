"""Find the class of a table's ``kind``, and build an object from the table.

A kind is a short name (`cosim.config.builtin_kinds`), ``module:Class`` or ``file.py:Class``. It is imported when a scenario
names it, so that ``import vcmvsp`` stays light; `only` limits the classes that may be imported. Other distributions add short
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
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from vcmvsp.cosim.config import binding, builtin_kinds
from vcmvsp.cosim.config.binding import show, unknown
from vcmvsp.cosim.config.builtin_kinds import KINDS, NOTHING, VERBS
from vcmvsp.cosim.config.provenance import NOWHERE, Source
from vcmvsp.cosim.errors import ScenarioError, place_of, words_of
from vcmvsp.cosim.util.documents import parts_of

_folder: contextvars.ContextVar[Path | None] = contextvars.ContextVar("folder", default=None)


SHIPPED = Path(__file__).resolve().parents[2] / "scenarios"
"""Folder of the built-in scenarios and their files."""


def located(name: str, folder: Path | None = None) -> Path:
    """Path of a file that a scenario names: beside the scenario, else among the built-in scenarios' files.

    Args:
        folder: the scenario's; default: that of `looking_in`, or the current one.
    """
    folder = folder or _folder.get() or Path()
    is_shipped = os.path.realpath(folder) == str(SHIPPED)
    places = (SHIPPED, Path()) if is_shipped else (folder, SHIPPED)  # a file that is not shipped was named by --set
    try:
        first, second = (Path(os.path.realpath(each / name)) for each in places)
        return first if first.exists() or not (is_shipped or second.is_file()) else second
    except (OSError, ValueError) as error:  # name too long, or with a zero byte
        raise ScenarioError(f"{show(name)} cannot be the name of a file") from error


@contextlib.contextmanager
def looking_in(folder: Path) -> Iterator[None]:
    """Set the folder of the files that an object under construction names in its parameters."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


def may_import(group: str, kind: object) -> bool:
    """Whether `find` may import the class of a kind: always a built-in one, others unless results are read."""
    return allowed_code.get() is not NO_CODE or (isinstance(kind, str) and kind in KINDS[group])


def find(group: str, kind: str, *, folder: Path | None = None, key: str = "kind", origin: Source = NOWHERE) -> Any:
    """The class that ``kind`` names.

    Args:
        group: group of the kind, e.g. ``"agent"``.
        folder: base of a relative file (the scenario's folder); default: that of `looking_in`, or the current one.

    Raises:
        ScenarioError: the kind is unknown, or its class cannot or must not be imported (`only`).
    """
    aim = target(group, kind, key=key, origin=origin)
    where, _, name = aim.rpartition(":")
    is_own = kind not in KINDS[group]
    try:
        path = file_of(kind, folder) if is_own else None
    except ScenarioError as error:
        raise origin.error(error.problem, key) from error
    if path and not path.is_file():
        raise origin.error(f"there is no file {path} on {platform.node()}", key)
    try:
        module = load_file(path) if path else importlib.import_module(where)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a user module may raise anything
        problem = f"'{where}' cannot be imported: {words_of(error)}{place_of(error)}"
        if isinstance(error, ModuleNotFoundError) and path is None and located(f"{where}.py", folder).is_file():
            problem += f"; did you mean '{where}.py:{name}'?"
        raise origin.error(problem, key) from error
    if is_own and (code := allowed_code.get()):
        code.took(kind, module)
    maker = getattr(module, name, None)
    if maker is None:
        raise origin.error(f"'{where}' has no class '{name}'", key)
    lacking = [verb for verb in re.findall(r"\w+(?:\(.*?\))?", VERBS[group]) if not hasattr(maker, verb.partition("(")[0])]
    if aim != NOTHING and (lacking or not callable(maker)):
        article = "an" if group[0] in "aeiou" else "a"
        problem = f"'{kind}' is not {article} {group.replace('_', '-')}: it lacks {', '.join(lacking) or VERBS[group]}"
        raise origin.error(problem, key)
    return maker


def target(group: str, kind: str, *, key: str = "kind", origin: Source = NOWHERE) -> str:
    """``module:Class`` or ``file.py:Class`` of a kind, also of a short name."""
    if ":" in kind:
        return kind
    if kind in KINDS[group]:
        return KINDS[group][kind]
    others = _entry_points(group)  # slow: searches all installed distributions
    if kind not in others:
        names = [*KINDS[group], *others]
        problem = unknown(f"{group.replace('_', '-')} kind", kind, names) + "; or give module:Class or file.py:Class"
        raise origin.error(problem, key)
    return others[kind]


def file_of(kind: str, folder: Path | None) -> Path | None:
    """The Python file of a kind that is not built in, or None if it is not in a file.

    Raises:
        ScenarioError: the kind must not be loaded (`only`).
    """
    if code := allowed_code.get():
        return code.file_of(kind)
    return located(kind.rpartition(":")[0], folder) if is_file_kind(kind) else None


def load_file(path: Path) -> ModuleType:
    """Import a Python file by its path, without a cache; it can import modules beside it."""
    name = f"_vcmvsp_{path.stem}_{hashlib.blake2b(str(path).encode(), digest_size=6).hexdigest()}"
    loader = importlib.machinery.SourceFileLoader(name, str(path))
    spec = importlib.machinery.ModuleSpec(name, loader, origin=str(path))
    spec.has_location = True  # sets __file__, by which the source is found
    module = importlib.util.module_from_spec(spec)
    before = {*sys.modules, name}
    sys.modules[name] = module
    sys.path.insert(0, str(path.parent))
    try:
        loader.exec_module(module)
    finally:
        sys.path.remove(str(path.parent))
        for module_name in [each for each in sys.modules if each not in before and _lies_in(sys.modules[each], path.parent)]:
            del sys.modules[module_name]  # modules beside the file are private to it and not cached
    return module


def _lies_in(module: ModuleType, folder: Path) -> bool:
    file = getattr(module, "__file__", None)
    return file is not None and Path(file).resolve().is_relative_to(folder)


def _entry_points(group: str) -> dict[str, str]:
    return {entry.name: entry.value for entry in importlib.metadata.entry_points(group=f"vcmvsp.{group}")}


Portable = Callable[[str], str]
"""Maps a kind to its name in the resolved scenario."""

Keep = Callable[[Path], str]
"""Keeps a file that the scenario uses and returns its name in the resolved scenario."""


def name_of(path: Path) -> str:
    """A `Keep` for a scenario that is not kept: returns the file's path."""
    return str(path)


def nothing() -> None:
    """Leaves the layer out."""


def build(
    group: str,
    content: Mapping[str, Any],
    *,
    key: str,
    source: Source,
    portable: Portable = str,
    arguments: Mapping[str, Any] | None = None,
    offered: Mapping[str, Any] | None = None,
    absent: Mapping[str, Any] | None = None,
    keep: Keep = name_of,
    guard: Callable[[Any], Any] = lambda kind: kind,
) -> tuple[Any, dict[str, Any]]:
    """Build the object of a table with a ``kind``.

    Args:
        portable: maps the kind to its name in the resolved scenario.
        arguments: values from the program instead of the table.
        offered: further such arguments, passed only to classes with these parameters.
        absent: arguments for parameters with default None that the table does not give.
        keep: keeps the files that the table names.
        guard: maps the found class to the class to build.

    Returns:
        The object, and the complete table.
    """
    kind = content.get("kind")
    if not isinstance(kind, str):
        allowed = ", ".join(builtin_kinds.KINDS[group])
        raise source.error(f"must be a string, one of {allowed}", f"{key}.kind")
    maker = guard(find(group, kind, folder=source.folder, key=f"{key}.kind", origin=source))
    known = binding.parameters(maker)
    arguments = {**(arguments or {}), **{name: value for name, value in (offered or {}).items() if name in known}}
    params = with_real_paths(maker, source.parameters(content, key, known), source, key)
    unset = {name for name, each in known.items() if each.default is None and not each.required} - {*params, *arguments}
    arguments |= {name: value for name, value in (absent or {}).items() if name in unset}
    built = binding.call(maker, params, key=key, origin=source, arguments=arguments)
    for path in getattr(built, "files", tuple)():  # files named inside its files
        if path.is_file():  # a missing file is reported by its reader
            keep(path)
    return built, {"kind": portable(kind), **with_kept_files(maker, binding.complete(maker, params, without=arguments), keep)}


def with_real_paths(target: Callable[..., Any], params: Mapping[str, Any], source: Source, key: str) -> dict[str, Any]:
    """The parameters of ``target`` with the real paths of the files that they name."""
    try:
        return binding.with_files(target, params, lambda name: str(located(name, source.folder)))
    except ScenarioError as error:
        raise source.error(error.problem, key) from error


def with_kept_files(target: Callable[..., Any], params: Mapping[str, Any], keep: Keep) -> dict[str, Any]:
    """The parameters with their existing files kept and named as in the resolved scenario."""
    return binding.with_files(target, params, lambda name: keep(Path(name)) if Path(name).is_file() else name)


_MODULE_KIND = re.compile(r"[A-Za-z_][\w.]*:[A-Za-z_]\w*")


def classes_in(value: object) -> list[str]:
    """All ``module:Class`` and ``file.py:Class`` strings in a TOML value."""
    if isinstance(value, str):
        return [value] if is_file_kind(value) or _MODULE_KIND.fullmatch(value) else []
    return list(dict.fromkeys(name for each in parts_of(value) for name in classes_in(each)))


def host_options(tables: object, folder: str) -> list[str]:
    """Options of ``vcmvsp agent`` that allow the classes that these tables name.

    Args:
        folder: of their Python files on the host's machine.
    """
    classes = classes_in(tables)
    options = [f"--allow={kind}" for kind in classes if not is_file_kind(kind)]
    return options if len(options) == len(classes) else [f"--folder={folder}", *options]


def is_file_kind(kind: str) -> bool:
    """Whether a kind names a file rather than a module or a short name."""
    return kind.rpartition(":")[0].endswith(".py")


class OwnCode:
    """The user classes that may be loaded besides built-in ones and, except with `NO_CODE`, installed short names.

    Args:
        kinds: ``module:Class`` or ``file.py:Class``, as on the host's command line.
        folder: of Python files that a run may name; None: no such files.
        tell: receives a line for the user about each loaded class.
    """

    def __init__(self, kinds: Collection[str], folder: Path | None, tell: Callable[[str], None] = lambda _: None) -> None:
        self._kinds, self._folder, self._tell = frozenset(kinds), folder, tell

    def file_of(self, kind: str) -> Path | None:
        """Path of this kind's file on this machine, or None for a module.

        Raises:
            ScenarioError: the user has not allowed this class.
        """
        if self is NO_CODE:
            raise ScenarioError(f"'{kind}' is user code, which is not executed when results are read; --trust allows it")
        if ":" not in kind:
            return None
        is_allowed, path = kind in self._kinds, Path(kind.rpartition(":")[0])
        if not is_file_kind(kind):
            if not is_allowed:
                raise ScenarioError(f"the run requests '{kind}', which this host does not allow: add --allow {kind}")
            return None
        if is_allowed and (path.is_file() or self._folder is None):
            return path.resolve()
        if self._folder is None:
            raise ScenarioError(
                f"the run requests '{kind}', but this host has no folder of code: add --folder DIR with {path.name}"
            )
        return (self._folder / path.name).resolve()

    def took(self, kind: str, module: ModuleType) -> None:
        """Tell the user which file a class comes from."""
        self._tell(f"{kind.rpartition(':')[2]} comes from {module.__file__}")


NO_CODE = OwnCode((), None)
"""Allows built-in classes only, to read results."""
allowed_code: contextvars.ContextVar[OwnCode | None] = contextvars.ContextVar("allowed_code", default=None)


@contextlib.contextmanager
def only(code: OwnCode | None) -> Iterator[None]:
    """Load only these user classes meanwhile, in a host or while results are read; None: no change."""
    token = allowed_code.set(code or allowed_code.get())
    try:
        yield
    finally:
        allowed_code.reset(token)
