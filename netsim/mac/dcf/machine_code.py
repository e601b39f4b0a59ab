"""Machine code of the core of DCF, if numba is installed, with a cache on disk.

The core uses the part of NumPy that numba compiles, with the same operations in the same order either way: results are equal
to the last bit. Cached code is loaded by llvmlite alone: importing numba takes many times longer. `VCMVSP_COMPILED=0` in the
environment turns compilation off.
"""

import contextlib
import ctypes
import hashlib
import importlib.util
import inspect
import os
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np

ENTRY = "run"
Layout = tuple[tuple[str, str, int], ...]
"""For each field of a `Block`: name, NumPy type string, number of dimensions; 0: a single number."""

Core = tuple[tuple[ModuleType, ...], Layout, Layout]
"""Modules with the function `ENTRY` in the last, and the fields of its two named tuples."""

_DIGEST_BYTES = 16  # of the code, at the beginning of a cache file
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, *(ctypes.c_void_p,) * 4, ctypes.c_int64)  # as numba has functions called
_loaded: dict[Core, "MachineCode"] = {}


def available() -> bool:
    """Whether functions will be compiled."""
    return os.environ.get("VCMVSP_COMPILED", "1") != "0" and importlib.util.find_spec("numba") is not None


class Block:
    """The C-contiguous arrays and numbers of a named tuple as 8-byte words: values, or addresses and shapes of arrays."""

    def __init__(self, fields: Any) -> None:
        self.fields = fields  # keeps the arrays alive
        words: list[int] = []
        layout: list[tuple[str, str, int]] = []
        for name, value in fields._asdict().items():
            array = np.asarray(value)
            if not array.flags.c_contiguous:
                raise ValueError(f"{name} is not C-contiguous")
            layout.append((name, array.dtype.str, array.ndim))
            words += [array.ctypes.data, *array.shape] if array.ndim else [int(array.view(np.int64))]
        self.layout: Layout = tuple(layout)
        self._words = np.array(words, np.int64)
        self.address = self._words.ctypes.data


class Compiled:
    """The loaded function `ENTRY` of two named tuples and a number; they may be replaced by others with the same fields."""

    def __init__(self, modules: tuple[ModuleType, ...], first: Any, second: Any) -> None:
        self._first, self._second = Block(first), Block(second)
        core = modules, self._first.layout, self._second.layout
        if core not in _loaded:
            _loaded[core] = MachineCode(_code(core))
        self._function = _loaded[core]

    def __call__(self, first: Any, second: Any, number: int) -> int:
        """Call the function; tuples of the previous call are not converted again."""
        if first is not self._first.fields:
            self._first = Block(first)
        if second is not self._second.fields:
            self._second = Block(second)
        return self._function(self._first.address, self._second.address, number)


def is_cached(modules: tuple[ModuleType, ...], first: Any, second: Any) -> bool:
    """Whether the code of `Compiled` for these arguments is in the cache folder."""
    return _read_code(_path((modules, Block(first).layout, Block(second).layout))) is not None


def is_loaded(modules: tuple[ModuleType, ...], first: Any, second: Any) -> bool:
    """Whether this process has loaded the code of `Compiled` for these arguments."""
    return (modules, Block(first).layout, Block(second).layout) in _loaded


def linked(modules: Sequence[ModuleType], make: Callable[[FunctionType], Any]) -> Any:
    """The function `ENTRY` with all functions of the modules replaced by ``make`` of their loops, ``f_loop`` for ``f``."""
    names = {name: value for module in modules for name, value in vars(module).items()}
    for name, value in list(names.items()):
        if isinstance(value, FunctionType) and value.__module__ in {module.__name__ for module in modules}:
            names[name] = make(FunctionType(names.get(f"{name}_loop", value).__code__, names, name))
    return names[ENTRY]


class MachineCode:
    """A function of two addresses of blocks and an integer that gives an integer."""

    def __init__(self, code: bytes) -> None:
        import llvmlite.binding as llvm

        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), host())  # the code lives as long as this
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        self._function = _FUNCTION(self._engine.get_function_address(ENTRY))
        self._result, self._error = ctypes.c_int64(), ctypes.c_void_p()
        self._places = ctypes.addressof(self._result), ctypes.addressof(self._error)

    def __call__(self, first: int, second: int, number: int) -> int:
        """Call it."""
        if self._function(*self._places, first, second, number):
            raise RuntimeError("the compiled DCF code failed")
        return self._result.value


def host() -> Any:
    """LLVM's target machine for this processor."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    options = {"opt": 3, "codemodel": "jitdefault", "jit": True}
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, **options)


def _code(core: Core) -> bytes:
    path = _path(core)
    code = _read_code(path)
    if code is None:
        import llvmlite.binding as llvm

        from vcmvsp.netsim.mac.dcf.compiler import assembly, compiled

        text = assembly(linked(core[0], compiled), *core[1:], ENTRY)
        code = host().emit_object(llvm.parse_assembly(text))
        _write_code(path, code)
    return code


def _path(core: Core) -> Path:
    """Cache file, named by a digest of sources, imported numbers, compiler and processor."""
    import llvmlite
    import llvmlite.binding as llvm

    modules, first, second = core
    numbers = [[each for each in vars(module).items() if isinstance(each[1], (int, float))] for module in modules]
    # Each release of numba goes with one of llvmlite.
    made_by = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), llvmlite.__version__
    digest = hashlib.blake2b(repr((numbers, first, second, made_by)).encode(), digest_size=16)
    makers = [Path(__file__), Path(__file__).with_name("compiler.py")]
    for source in [Path(inspect.getfile(module)) for module in modules] + makers:
        digest.update(source.read_bytes())
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
