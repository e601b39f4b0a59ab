"""Compilation of functions to machine code, if numba is installed, with a cache on disk.

The functions use the part of NumPy that numba compiles, with the same operations in the same order either way: results are
equal to the last bit. `VCMVSP_COMPILED=0` in the environment turns compilation off. The cache is in the user's cache folder;
file names are digests of everything that the code depends on.
"""

import contextlib
import hashlib
import importlib
import importlib.util
import os
import sys
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

from vcmvsp.netsim.mac.jit.argument_block import Block, Layout

_MAKERS = tuple(str(Path(__file__).with_name(name)) for name in ("compiler.py", "loader.py"))
_DIGEST_BYTES = 16  # of the code, at the beginning of a cache file
_functions: dict[tuple[tuple[str, ...], str, Layout, Layout], Callable[[int, int, int], int]] = {}  # that are loaded


def available() -> bool:
    """Whether functions will be compiled."""
    return os.environ.get("VCMVSP_COMPILED", "1") != "0" and importlib.util.find_spec("numba") is not None


class Compiled:
    """A compiled function of two named tuples of arrays and numbers, and of a number.

    Args:
        names: modules of the functions, which call only functions of earlier ones. ``f_loop`` is compiled instead of ``f`` if
            the module has both. They allocate no arrays.
        entry: name of the function, in the last module.
        first, second: arguments, or others with the same fields.
    """

    def __init__(self, names: tuple[str, ...], entry: str, first: Any, second: Any) -> None:
        self._first, self._second = Block(first), Block(second)
        self._function = _shared(names, entry, self._first.layout, self._second.layout)

    def __call__(self, first: Any, second: Any, number: int) -> int:
        """Call the function; tuples of the previous call are not converted again."""
        if first is not self._first.fields:
            self._first = Block(first)
        if second is not self._second.fields:
            self._second = Block(second)
        return self._function(self._first.address, self._second.address, number)


def is_cached(names: tuple[str, ...], entry: str, first: Any, second: Any) -> bool:
    """Whether the function of `Compiled` for these arguments is in the cache folder."""
    return _read_code(_path(names, entry, Block(first).layout, Block(second).layout)) is not None


def is_loaded(names: tuple[str, ...], entry: str, first: Any, second: Any) -> bool:
    """Whether this process has loaded the function of `Compiled` for these arguments."""
    return (names, entry, Block(first).layout, Block(second).layout) in _functions


def _shared(names: tuple[str, ...], entry: str, first: Layout, second: Layout) -> Callable[[int, int, int], int]:
    key = names, entry, first, second
    if key not in _functions:
        _functions[key] = _function(*key)
    return _functions[key]


def _function(names: tuple[str, ...], entry: str, first: Layout, second: Layout) -> Callable[[int, int, int], int]:
    path = _path(names, entry, first, second)
    code = _read_code(path)
    if code is None:
        make: Any = importlib.import_module("vcmvsp.netsim.mac.jit.compiler")
        modules = [_copy_of(name, "compiled") for name in names]
        code = make.machine_code(_linked(modules, entry, make.compiled), first, second)
        _write_code(path, code)
    function: Callable[[int, int, int], int] = importlib.import_module("vcmvsp.netsim.mac.jit.loader").Loaded(code)
    return function


@cache
def looped(names: tuple[str, ...], entry: str) -> Callable[..., int]:
    """The loops of `Compiled` in plain Python, faster than NumPy for arrays of a few numbers."""
    return _linked([_copy_of(name, "looped") for name in names], entry, lambda source: source)


def _linked(modules: list[ModuleType], entry: str, make: Callable[[FunctionType], Any]) -> Callable[..., int]:
    """The entry function after replacing all functions of the modules by ``make`` of their loops."""
    done: dict[str, object] = {}
    for module in modules:
        for name, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value.__module__ == module.__name__:
                done[name] = make(vars(module).get(f"{name}_loop", value))
            if name in done:
                setattr(module, name, done[name])
    function: Callable[..., int] = getattr(modules[-1], entry)
    return function


def _copy_of(name: str, purpose: str) -> ModuleType:
    """A second instance of a module, under another name."""
    original = importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(f"{name}__{purpose}", str(original.__file__))
    if spec is None or spec.loader is None:
        raise ImportError(f"{name} has no source file", name=name)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


# --- files of compiled code ---


def _path(names: tuple[str, ...], entry: str, first: Layout, second: Layout) -> Path:
    """Cache file, named by a digest of sources, imported numbers, compiler and processor."""
    digest = hashlib.blake2b(digest_size=16)
    modules = [importlib.import_module(name) for name in names]
    for module in modules:
        digest.update(repr([each for each in vars(module).items() if isinstance(each[1], (int, float))]).encode())
    for source in (*(str(module.__file__) for module in modules), *_MAKERS):
        digest.update(Path(source).read_bytes())
    host = importlib.import_module("vcmvsp.netsim.mac.jit.loader").host_name()
    digest.update(repr((entry, first, second, host)).encode())
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vcmvsp"
    return folder / f"{digest.hexdigest()}.code"


def _read_code(path: Path) -> bytes | None:
    """The code in a file; None if it is missing or damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    digest, code = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    return code if digest == _digest(code) else None


def _write_code(path: Path, code: bytes) -> None:
    """Write a file atomically, if possible."""
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, delete=False) as file:
            file.write(_digest(code) + code)
        Path(file.name).replace(path)


def _digest(code: bytes) -> bytes:
    return hashlib.blake2b(code, digest_size=_DIGEST_BYTES).digest()
