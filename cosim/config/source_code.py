"""Fingerprint of a class's source code, to compare the code of two machines.

It covers the file of the class and the files beside it that it imports, found by parsing import statements without running
them. vcmvsp itself and NumPy are compared by version.
"""

import ast
import contextlib
import hashlib
import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path

from vcmvsp.cosim.agent import AgentSpec
from vcmvsp.cosim.config import registry
from vcmvsp.cosim.config.registry import classes_in, is_file_kind
from vcmvsp.cosim.errors import ScenarioError

LIBRARIES = ("vcmvsp", "numpy")
MOST_FILES = 1000
_INSTALLED = frozenset({"site-packages", "dist-packages"})


def fingerprint(spec: AgentSpec) -> dict[str, str]:
    """SHA-256 of each source file of an agent, by file name, and versions of libraries.

    Files that are not on this machine are left out.
    """
    versions = {name: metadata.version(name) for name in LIBRARIES}
    kind = spec.kind
    with contextlib.suppress(ScenarioError):  # a short name unknown on this machine
        kind = registry.target("agent", spec.kind)
    for each in classes_in([kind, spec.params, spec.defaults]):
        path = _path(each, Path(spec.folder))
        if path is not None and path.is_file():
            versions |= _sources(path.resolve())
    return versions


def difference(here: Mapping[str, str], there: Mapping[str, str]) -> str:
    """Difference of another machine's code from this machine's, in words; empty if equal."""
    words = []
    for name in sorted({*here, *there}):
        ours, theirs = here.get(name), there.get(name)
        if ours is None or theirs is None:
            words.append(f"{name} is only {'there' if ours is None else 'here'}")
        elif ours != theirs:
            words.append(f"{name} {theirs} there, {ours} here" if name in LIBRARIES else f"{name} differs")
    return "; ".join(words)


def _path(kind: str, folder: Path) -> Path | None:
    """The file of a class; a module is located without importing it."""
    module = kind.partition(":")[0]
    if is_file_kind(kind):
        return registry.file_of(kind, folder)
    if module.startswith("vcmvsp."):
        return None  # compared by version
    with contextlib.suppress(ImportError, ValueError):
        spec = importlib.util.find_spec(module)
        return Path(spec.origin) if spec is not None and spec.origin else None
    return None


def _sources(path: Path) -> dict[str, str]:
    """The file and the files beside it that it imports, transitively; in an installed package, of that package only."""
    root = path.parent
    while (root / "__init__.py").is_file():
        root = root.parent
    only = path.relative_to(root).parts[0] if root.name in _INSTALLED else None
    hashes: dict[str, str] = {}
    waiting = [path]
    while waiting and len(hashes) < MOST_FILES:
        file = waiting.pop()
        name = file.relative_to(root).as_posix()
        if name in hashes or only not in (None, name.partition("/")[0]):
            continue
        content = file.read_bytes()
        hashes[name] = hashlib.sha256(content).hexdigest()
        waiting += _imported(content, file, root)
    return hashes


def _imported(content: bytes, file: Path, root: Path) -> Iterator[Path]:
    """The source files below ``root`` that a file imports, with the ``__init__.py`` of enclosing packages."""
    try:
        tree = ast.parse(content)
    except (SyntaxError, ValueError, RecursionError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [(root, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = root if node.level == 0 else file.parents[node.level - 1]
            module = node.module or ""
            names = [(base, f"{module}.{alias.name}".lstrip(".")) for alias in node.names]
        else:
            continue
        for base, name in names:
            yield from _files(base, name.split("."), root)


def _files(folder: Path, names: Sequence[str], root: Path) -> Iterator[Path]:
    """The source files of a module in a folder, and of its enclosing packages."""
    for count in range(len(names) + 1):
        module = folder.joinpath(*names[:count])
        for file in (module.parent / f"{module.name}.py", module / "__init__.py"):
            if file.is_relative_to(root) and file.is_file():
                yield file
