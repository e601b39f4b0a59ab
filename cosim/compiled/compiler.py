"""Compilation by numba.

Numba passes a named tuple of arrays field by field: every call moves hundreds of words. Here a
`cosim.compiled.machine_code.Block` is a type of numba, one pointer: ``block.field`` in compiled code reads its words.
"""

# numba is only partly typed.
# mypy: allow-untyped-calls, allow-untyped-decorators, allow-subclassing-any, disable-error-code="override"

import hashlib
import math
import operator
from collections.abc import Callable, Sequence
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import from_dtype, types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import infer_getattr, lower_builtin, lower_getattr_generic, models, register_model
from numba.np.arrayobj import make_array, populate_array

# The code allocates nothing and is not called by Python, so it needs no runtime of numba.
OPTIONS: dict[str, Any] = {
    "error_model": "numpy",
    "_nrt": False,
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
Layout = Sequence[tuple[str, str, int, int]]
"""For each field of a block: name, NumPy type string, number of dimensions (0: a single number), arrays (0: not a tuple)."""

# The C library's, as in interpreted code: a calculation of sine and cosine at once may differ in the last bit.
_ONE, _TWO = types.float64(types.float64), types.float64(types.float64, types.float64)
EXTERNAL: dict[Any, Any] = {each: types.ExternalFunction(each.__name__, _ONE) for each in (math.sin, math.cos, math.exp)}
EXTERNAL[math.atan2] = types.ExternalFunction("atan2", _TWO)


def compiled(source: Callable[..., Any], *, inline: bool) -> Any:
    """A function for calls from compiled functions; ``inline``: it is put into its callers."""
    return numba.njit(**OPTIONS, forceinline=inline)(source)


def assembly(function: Any, first: Layout, second: Layout, name: str) -> str:
    """LLVM assembly of a `compiled` function (block, block, integer) -> integer, under this name."""
    blocks = BlockType(first), BlockType(second)
    rows = [
        array
        for block in blocks
        for field in block.fields.values()
        for array in _flat(field)
        if isinstance(array, DistinctArray)
    ]
    for row in rows:
        row.rows[:] = [each.name for each in rows]
    function.compile((*blocks, types.int64))
    (signature,) = function.signatures
    text: str = function.inspect_llvm(signature)
    return text.replace(function.overloads[signature].fndesc.llvm_func_name, name)


class BlockType(types.Type):
    """Numba's type of a pointer to a `Block` with these fields."""

    def __init__(self, layout: Layout) -> None:
        name = f"Block({hashlib.blake2b(repr(layout).encode(), digest_size=8).hexdigest()})"
        self.fields: dict[str, Any] = {}
        self.word: dict[str, int] = {}  # at which the field begins
        at = 0
        for field, kind, dimensions, rows in layout:
            number = from_dtype(np.dtype(kind))
            self.word[field] = at
            arrays = [_array(number, dimensions, f"{name}.{field}[{row}]") for row in range(max(rows, 1))]
            self.fields[field] = types.Tuple(arrays) if rows else arrays[0]
            at += (1 + dimensions) * len(arrays)
        super().__init__(name=name)


class DistinctArray(types.Array):
    """A one-dimensional array that overlaps with no other: loops over several rows can be vectorized.

    Indices of its elements are not negative.
    """

    def __init__(self, number: Any, name: str) -> None:
        super().__init__(number, 1, "C", name=name)
        self.rows: list[str] = []  # names of all

    @property
    def key(self) -> Any:
        """The name: types with equal keys are one type for numba."""
        return self.name


def _flat(field: Any) -> tuple[Any, ...]:
    return tuple(field) if isinstance(field, types.Tuple) else (field,)


def _array(number: Any, dimensions: int, name: str) -> Any:
    if dimensions == 1:
        return DistinctArray(number, name)
    return types.Array(number, dimensions, "C") if dimensions else number


register_model(DistinctArray)(models.ArrayModel)
register_model(BlockType)(models.OpaqueModel)


@lower_builtin(operator.getitem, DistinctArray, types.Integer)
def _read(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    row = signature.args[0]
    read = builder.load(_place(context, builder, signature, values))
    _tell_apart(builder, read, row)
    return context.data_model_manager[row.dtype].from_data(builder, read)


@lower_builtin(operator.setitem, DistinctArray, types.Integer, types.Any)
def _write(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    row, _, kind = signature.args
    value = context.cast(builder, values[2], kind, row.dtype)
    stored = context.data_model_manager[row.dtype].as_data(builder, value)
    _tell_apart(builder, builder.store(stored, _place(context, builder, signature, values)), row)
    return context.get_dummy_value()


def _place(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    row, kind = signature.args[:2]
    index = context.cast(builder, values[1], kind, types.intp)
    return cgutils.gep_inbounds(builder, make_array(row)(context, builder, values[0]).data, index)


def _tell_apart(builder: Any, access: Any, row: DistinctArray) -> None:
    """Mark a read or write: no access to another row has its address."""
    module = builder.module
    domain = module.add_metadata([ir.MetaDataString(module, "rows")])

    def scopes(names: Sequence[str]) -> Any:
        return module.add_metadata([module.add_metadata([ir.MetaDataString(module, name), domain]) for name in names])

    access.set_metadata("alias.scope", scopes([row.name]))
    access.set_metadata("noalias", scopes([name for name in row.rows if name != row.name]))


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
        place = builder.bitcast(cgutils.gep_inbounds(builder, block, word_bytes * at), what.as_pointer())
        read = builder.load(place)
        read.set_metadata("invariant.load", builder.module.add_metadata([]))
        return read

    at = kind.word[name]
    arrays = []
    for each in _flat(field):
        if not isinstance(each, types.Array):
            return word(at, context.get_value_type(each))
        shape = [word(at + 1 + k, size) for k in range(each.ndim)]
        strides = [size(context.get_abi_sizeof(context.get_data_type(each.dtype)))]
        for extent in shape[:0:-1]:
            strides.insert(0, builder.mul(strides[0], extent))
        array = make_array(each)(context, builder)
        data = word(at, context.get_data_type(each.dtype).as_pointer())
        populate_array(array, data=data, shape=shape, strides=strides, itemsize=strides[-1], meminfo=None)
        arrays.append(array._getvalue())  # noqa: SLF001 -- the interface of numba
        at += 1 + each.ndim
    return context.make_tuple(builder, field, arrays) if isinstance(field, types.BaseTuple) else arrays[0]
