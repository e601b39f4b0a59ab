"""Machine code of numerical loops, with a cache on disk.

A core is a function of two named tuples of arrays and numbers, and of an integer. It is written in the part of Python and NumPy
that numba compiles, and does the same operations in the same order interpreted and compiled: results are equal to the last bit.
It reads and writes single elements, of tables as ``table[i][j]``, allocates nothing, and takes sine, cosine, ``exp`` and
``atan2`` from `math` by name. Cached code is loaded by llvmlite alone: importing numba takes many times longer.
`VCMVSP_COMPILED=0` in the environment turns compilation off.

``INLINE = True`` in the module of the core puts each function into its callers: small functions in large loops are a tenth
faster, and compilation takes half as long again.
"""

import contextlib
import ctypes
import hashlib
import importlib.util
import inspect
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, cached_property, partial
from pathlib import Path
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Any

import numpy as np

ENTRY = "run"
Layout = tuple[tuple[str, str, int, int], ...]
"""For each field of a `Block`: name, NumPy type string, number of dimensions (0: a single number), arrays (0: not a tuple)."""

Program = tuple[tuple[ModuleType, ...], Layout, Layout]
"""Modules with the function `ENTRY` in the last, and the fields of its two named tuples."""

Run = Callable[[Any, Any, int], int]
"""The function `ENTRY` of two named tuples and a number."""

LOAD_S = 0.05  # CPU time for which loading cached code pays
_DIGEST_BYTES = 16  # of the code, at the beginning of a cache file
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, *(ctypes.c_void_p,) * 4, ctypes.c_int64)  # as numba has functions called
_loaded: dict[Program, "MachineCode"] = {}
_work_s: dict[Program, float] = {}  # CPU time of work, interpreted, since the cache folder was last asked for the code


def available() -> bool:
    """Whether functions will be compiled."""
    return os.environ.get("VCMVSP_COMPILED", "1") != "0" and _has_numba()


@cache
def _has_numba() -> bool:
    return importlib.util.find_spec("numba") is not None


class Block:
    """Numbers, C-contiguous arrays, and tuples of like arrays, as 8-byte words: values, or addresses and shapes of arrays.

    All are fields of a named tuple. No two arrays may overlap.
    """

    def __init__(self, fields: Any) -> None:
        self.fields = fields  # keeps the arrays alive
        words: list[int] = []
        layout: list[tuple[str, str, int, int]] = []
        for name, value in fields._asdict().items() if fields else ():
            rows = len(value) if isinstance(value, tuple) else 0
            arrays = [*map(np.asarray, value if rows else (value,))]
            for array in arrays:
                if not array.flags.c_contiguous:
                    raise ValueError(f"{name} is not C-contiguous")
                words += [array.ctypes.data, *array.shape] if array.ndim else [int(array.view(np.int64))]
            layout.append((name, arrays[0].dtype.str, arrays[0].ndim, rows))
        self.layout: Layout = tuple(layout)
        self._words = np.array(words, np.int64)
        self.address = self._words.ctypes.data


class Core:
    """The function `ENTRY` of the last of these modules, for named tuples with the same fields as these two.

    ``modules`` are all whose functions it calls.
    """

    def __init__(self, modules: tuple[ModuleType, ...], first: Any, second: Any) -> None:
        self._program = modules, Block(first).layout, Block(second).layout
        self._compiled: Compiled | None = None

    @property
    def interpreted(self) -> Run:
        """The function with memory views for arrays: their elements are Python's numbers, several times as fast as NumPy's."""
        return Interpreted(getattr(self._program[0][-1], ENTRY))

    @property
    def compiled(self) -> Run:
        """Compiled code, which is loaded or made now."""
        if not self.is_loaded:
            _loaded[self._program] = MachineCode(_code(self._program))
        if self._compiled is None:
            self._compiled = Compiled(_loaded[self._program])
        return self._compiled

    def call(self, first: Any, second: Any, number: int) -> int:
        """Call compiled code that is loaded, once with these arrays."""
        return _loaded[self._program](Block(first), Block(second), number)

    @property
    def is_loaded(self) -> bool:
        """Whether this process has loaded the compiled code."""
        return self._program in _loaded

    @property
    def is_cached(self) -> bool:
        """Whether the compiled code is in the cache folder."""
        return _read_code(self._file) is not None

    @cached_property
    def _file(self) -> Path:
        """Cache file; its name is a digest of sources, which takes 2 ms."""
        return _path(self._program)

    def chosen(self, work_s: float, compile_for_s: float) -> Run:
        """The way for work that takes ``work_s`` CPU s interpreted.

        Many small calls count as one large call. Compilation pays from ``compile_for_s`` on, of all work for which this was
        called on this computer so far.
        """
        if not available():
            return self.interpreted
        if self.is_loaded:
            return self.compiled
        work_s += _work_s.pop(self._program, 0.0)
        if work_s < LOAD_S:
            _work_s[self._program] = work_s
            return self.interpreted
        pays = self.is_cached or _total_s(self._file, work_s) >= compile_for_s
        return self.compiled if pays else self.interpreted


class Converting:
    """A function of two named tuples and a number, which takes them in a form of its own."""

    form: Callable[[Any], Any]

    def __init__(self, function: Run) -> None:
        self._function = function
        self._first = self._second = self._first_form = self._second_form = None

    def __call__(self, first: Any, second: Any, number: int) -> int:
        """Call the function; tuples of the previous call are not converted again."""
        if first is not self._first:
            self._first, self._first_form = first, self.form(first)
        if second is not self._second:
            self._second, self._second_form = second, self.form(second)
        return self._function(self._first_form, self._second_form, number)


def views(fields: Any) -> Any:
    """A named tuple with memory views in place of arrays, tuples of them in place of arrays of rows."""
    return fields._replace(**{name: _view(value) for name, value in fields._asdict().items()})


def _view(value: Any) -> Any:
    if isinstance(value, tuple) or np.ndim(value) > 1:
        return tuple(_view(each) for each in value)  # rows
    return value.data if isinstance(value, np.ndarray) else value


class Interpreted(Converting):
    """The function with memory views for arrays."""

    form = staticmethod(views)


class Compiled(Converting):
    """The function in machine code."""

    form = Block


def linked(modules: Sequence[ModuleType], make: Callable[[FunctionType], Any], external: Mapping[Any, Any]) -> Any:
    """The function `ENTRY` with all functions of the modules replaced by ``make`` of them, others by those in ``external``."""
    names = {name: value for module in modules for name, value in vars(module).items()}
    for name, value in list(names.items()):
        if isinstance(value, BuiltinFunctionType):
            names[name] = external.get(value, value)
        if isinstance(value, FunctionType) and value.__module__ in {module.__name__ for module in modules}:
            names[name] = make(FunctionType(value.__code__, names, name))
    return names[ENTRY]


class MachineCode:
    """A function of two blocks and an integer that gives an integer."""

    def __init__(self, code: bytes) -> None:
        import llvmlite.binding as llvm

        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), host())  # the code lives as long as this
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        self._function = _FUNCTION(self._engine.get_function_address(ENTRY))
        self._result, self._error = ctypes.c_int64(), ctypes.c_void_p()
        self._places = ctypes.addressof(self._result), ctypes.addressof(self._error)

    def __call__(self, first: Block, second: Block, number: int) -> int:
        """Call the function with two blocks and a number."""
        if self._function(*self._places, first.address, second.address, number):
            raise RuntimeError("compiled code failed")
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


def _code(program: Program) -> bytes:
    path = _path(program)
    code = _read_code(path)
    if code is None:
        with _locked(path.with_suffix(".lock")):
            code = _read_code(path)  # another process may have made it in the meantime
            if code is None:
                code = _compile(program)
                _write_code(path, code)
    return code


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Wait for other processes with this lock, if files can be locked here."""
    with contextlib.ExitStack() as stack:
        with contextlib.suppress(ImportError, OSError):
            import fcntl

            path.parent.mkdir(parents=True, exist_ok=True)
            fcntl.flock(stack.enter_context(path.open("w")), fcntl.LOCK_EX)
        yield


def _compile(program: Program) -> bytes:
    import llvmlite.binding as llvm

    from vcmvsp.cosim.compiled.compiler import EXTERNAL, assembly, compiled

    make = partial(compiled, inline=getattr(program[0][-1], "INLINE", False))
    text = assembly(linked(program[0], make, EXTERNAL), *program[1:], ENTRY)
    return host().emit_object(llvm.parse_assembly(text))


def _path(program: Program) -> Path:
    """Cache file, named by a digest of sources, imported numbers, compiler and processor."""
    import llvmlite
    import llvmlite.binding as llvm

    modules, first, second = program
    # Each release of numba goes with one of llvmlite.
    made_by = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), llvmlite.__version__
    digest = hashlib.blake2b(repr((*map(_numbers, modules), first, second, made_by)).encode(), digest_size=16)
    makers = [Path(__file__), Path(__file__).with_name("compiler.py")]
    for source in [Path(inspect.getfile(module)) for module in modules] + makers:
        digest.update(source.read_bytes())
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "vcmvsp"
    return folder / f"{digest.hexdigest()}.code"


def _numbers(module: ModuleType) -> list[tuple[str, float]]:
    return [(name, value) for name, value in vars(module).items() if isinstance(value, (int, float))]


def _total_s(path: Path, work_s: float) -> float:
    """CPU time of all work for which the code of a cache file was missing, with this work; kept beside the file."""
    note, total_s = path.with_suffix(".work"), work_s
    with contextlib.suppress(OSError, ValueError):
        total_s += float(note.read_text("ascii"))
    with contextlib.suppress(OSError):
        note.parent.mkdir(parents=True, exist_ok=True)
        note.write_text(f"{total_s:.3f}", "ascii")
    return total_s


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
