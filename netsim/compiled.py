"""Functions compiled to machine code, where numba is installed; else as they are.

The functions are written in the part of NumPy that numba compiles, and do the same operations in the same order either way:
what they compute is the same to the last bit. `VCMVSP_COMPILED=0` in the environment turns compilation off.

What has been compiled is kept in the user's cache folder, under a digest of its sources: a change makes it compile anew.
"""

import hashlib
import importlib
import importlib.util
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any


def available() -> bool:
    """Whether functions will be compiled."""
    return os.environ.get("VCMVSP_COMPILED", "1") != "0" and importlib.util.find_spec("numba") is not None


class Compiled:
    """A function of two named tuples of arrays and numbers, and of a number, compiled with all that it calls.

    Args:
        names: modules whose functions call each other, each those of modules before it; no others. A function ``f`` is compiled
            from ``f_loop`` where its module has that too.
        entry: name of the function, in the last of them.
    """

    def __init__(self, names: tuple[str, ...], entry: str) -> None:
        self._function = _compiled(names, entry)
        self._pack: Any = importlib.import_module("netsim.compiled_block").Block
        self._first = self._second = self._pack(())

    def __call__(self, first: Any, second: Any, number: int) -> int:
        """Call it: the first time this may take long. Of tuples that are those of the call before nothing is copied."""
        if first is not self._first.fields:
            self._first = self._pack(first)
        if second is not self._second.fields:
            self._second = self._pack(second)
        return self._function(self._first, self._second, number)


@cache
def _compiled(names: tuple[str, ...], entry: str) -> Callable[..., int]:
    numba: Any = importlib.import_module("numba")
    modules = [_load(name, "compiled") for name in names]
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vcmvsp" / _digest(modules)
    options = {"cache": _writable(folder), "no_cfunc_wrapper": True, "error_model": "numpy"}
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(folder)
    try:
        return _linked(modules, entry, lambda name, source: numba.njit(no_cpython_wrapper=name != entry, **options)(source))
    finally:
        numba.config.CACHE_DIR = before


@cache
def looped(names: tuple[str, ...], entry: str) -> Callable[..., int]:
    """The function of the same loops that `Compiled` compiles, as they are: for arrays of a few numbers quicker than NumPy."""
    return _linked([_load(name, "looped") for name in names], entry, lambda _, source: source)


def _linked(modules: list[ModuleType], entry: str, make: Callable[[str, FunctionType], Any]) -> Callable[..., int]:
    """The function, where all functions of the modules call what is made of their loops."""
    done: dict[str, object] = {}
    for module in modules:
        for name, value in list(vars(module).items()):
            if isinstance(value, FunctionType) and value.__module__ == module.__name__:
                done[name] = make(name, vars(module).get(f"{name}_loop", value))
            if name in done:
                setattr(module, name, done[name])
    function: Callable[..., int] = getattr(modules[-1], entry)
    return function


def _digest(modules: list[ModuleType]) -> str:
    """Of all that the machine code depends on: the sources, and the numbers in them that come from elsewhere."""
    digest = hashlib.blake2b(digest_size=8)
    for module in modules:
        digest.update(Path(str(module.__file__)).read_bytes())
        digest.update(repr([each for each in vars(module).items() if isinstance(each[1], (int, float))]).encode())
    return digest.hexdigest()


def _load(name: str, purpose: str) -> ModuleType:
    """Another copy of a module, under a name of its own."""
    original = importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(f"{name}__{purpose}", str(original.__file__))
    if spec is None or spec.loader is None:
        raise ImportError(f"{name} has no source file", name=name)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def _writable(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return False
    return os.access(folder, os.W_OK)
