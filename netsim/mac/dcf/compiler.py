"""Compilation by numba.

Numba passes a named tuple of arrays field by field: every call moves hundreds of words. Here a
`netsim.mac.dcf.machine_code.Block` is a type of numba, one pointer: ``block.field`` in compiled code reads its words.
"""

# numba is only partly typed.
# mypy: allow-untyped-calls, allow-untyped-decorators, allow-subclassing-any, disable-error-code="override"

import hashlib
from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
from numba import from_dtype, types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, lower_getattr_generic, models, register_model
from numba.np.arrayobj import make_array, populate_array

# The code allocates nothing and is not called by Python, so it needs no runtime of numba.
OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
Layout = Sequence[tuple[str, str, int]]
"""For each field of a block: name, NumPy type string, number of dimensions; 0: a single number."""


def compiled(source: Callable[..., Any]) -> Any:
    """A function for calls from compiled functions."""
    return numba.njit(**OPTIONS)(source)


def assembly(function: Any, first: Layout, second: Layout, name: str) -> str:
    """LLVM assembly of a `compiled` function (block, block, integer) -> integer, under this name."""
    function.compile((BlockType(first), BlockType(second), types.int64))
    (signature,) = function.signatures
    text: str = function.inspect_llvm(signature)
    return text.replace(function.overloads[signature].fndesc.llvm_func_name, name)


class BlockType(types.Type):
    """A block with these fields."""

    def __init__(self, layout: Layout) -> None:
        self.fields: dict[str, Any] = {}
        self.word: dict[str, int] = {}  # at which the field begins
        at = 0
        for name, kind, dimensions in layout:
            number = from_dtype(np.dtype(kind))
            self.fields[name] = types.Array(number, dimensions, "C") if dimensions else number
            self.word[name] = at
            at += 1 + dimensions
        super().__init__(name=f"Block({hashlib.blake2b(repr(layout).encode(), digest_size=8).hexdigest()})")


register_model(BlockType)(models.OpaqueModel)


@infer_getattr
class BlockAttribute(AttributeTemplate):
    """The type of a field."""

    key = BlockType

    def generic_resolve(self, kind: BlockType, name: str) -> Any:
        """None if there is no such field."""
        return kind.fields.get(name)


@lower_getattr_generic(BlockType)
def _field(context: Any, builder: Any, kind: BlockType, block: Any, name: str) -> Any:
    """Read a field. No word of a block ever changes: the compiler need not read it twice."""
    field = kind.fields[name]
    size = context.get_value_type(types.intp)
    word_bytes = context.get_abi_sizeof(size)

    def word(at: int, what: Any) -> Any:
        place = builder.bitcast(cgutils.gep_inbounds(builder, block, word_bytes * (kind.word[name] + at)), what.as_pointer())
        read = builder.load(place)
        read.set_metadata("invariant.load", builder.module.add_metadata([]))
        return read

    if not isinstance(field, types.Array):
        return word(0, context.get_value_type(field))
    item = context.get_abi_sizeof(context.get_data_type(field.dtype))
    shape = [word(1 + k, size) for k in range(field.ndim)]
    strides = [size(item)]
    for each in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], each))
    array = make_array(field)(context, builder)
    data = word(0, context.get_data_type(field.dtype).as_pointer())
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=item, meminfo=None)
    return array._getvalue()  # noqa: SLF001 -- the interface of numba
