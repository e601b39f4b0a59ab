"""Loads machine code with llvmlite alone: importing numba takes many times longer."""

import ctypes
from typing import Any

import llvmlite
import llvmlite.binding as llvm

ENTRY = "run"
_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int32, *(ctypes.c_void_p,) * 4, ctypes.c_int64)  # as numba has functions called


class Loaded:
    """A function of two blocks (`netsim.mac.jit.argument_block`) and an integer that gives an integer."""

    def __init__(self, code: bytes) -> None:
        self._engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), host())  # the code lives as long as this
        self._engine.add_object_file(llvm.ObjectFileRef.from_data(code))
        self._engine.finalize_object()
        self._function = _FUNCTION(self._engine.get_function_address(ENTRY))
        self._result, self._error = ctypes.c_int64(), ctypes.c_void_p()
        self._places = ctypes.addressof(self._result), ctypes.addressof(self._error)

    def __call__(self, first: int, second: int, number: int) -> int:
        """Call it with the addresses of blocks."""
        if self._function(*self._places, first, second, number):
            raise RuntimeError("compiled code has failed")
        return self._result.value


def host() -> Any:
    """What this computer's processor can do, for LLVM."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target = llvm.Target.from_default_triple()
    features = llvm.get_host_cpu_features().flatten()
    options = {"opt": 3, "codemodel": "jitdefault", "jit": True}
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, **options)


def host_name() -> str:
    """That, and the version of what makes code for it: each release of numba goes with one of llvmlite."""
    return f"{llvm.get_host_cpu_name()} {llvm.get_host_cpu_features().flatten()} {llvmlite.__version__}"
