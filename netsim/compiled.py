"""Functions compiled to machine code, where numba is installed; else as they are.

The functions are written in the part of NumPy that numba compiles, and do the same operations in the same order either way:
what they compute is the same to the last bit. `VCMVSP_COMPILED=0` in the environment turns compilation off.

What has been compiled is kept in the user's cache folder, under a digest of the sources: a change makes it compile anew.
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


@cache
def compiled(names: tuple[str, ...], entry: str) -> Callable[..., int]:
    """A function, compiled with all that it calls, the first time that it is called.

    Args:
        names: modules whose functions call each other, each those of modules before it; no others.
        entry: name of the function, in the last of them.
    """
    numba: Any = importlib.import_module("numba")

    modules = [_load(name) for name in names]
    digest = hashlib.blake2b(b"".join(Path(str(module.__file__)).read_bytes() for module in modules), digest_size=8).hexdigest()
    cache_folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vcmvsp" / digest
    use = _writable(cache_folder)
    done: dict[str, object] = {}
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(cache_folder)
    try:
        for module in modules:
            for name, value in list(vars(module).items()):
                if isinstance(value, FunctionType) and value.__module__ == module.__name__:
                    inner = name != entry
                    done[name] = numba.njit(cache=use, no_cpython_wrapper=inner, no_cfunc_wrapper=True)(value)
                if name in done:
                    setattr(module, name, done[name])
    finally:
        numba.config.CACHE_DIR = before
    function: Callable[..., int] = getattr(modules[-1], entry)
    return function


def _load(name: str) -> ModuleType:
    """A second copy of a module, under a name of its own."""
    original = importlib.import_module(name)
    spec = importlib.util.spec_from_file_location(f"{name}__compiled", str(original.__file__))
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
