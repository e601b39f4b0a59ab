"""Named arrays and numbers that compiled code takes as one pointer. Needs numba.

Numba passes a named tuple of arrays field by field: every call of every function moves hundreds of words, and the compiler
has to see through all of them. A block is a row of 8-byte words, for every field of the tuple its value, or, of an
array, where its data are and its shape; ``block.field`` in compiled code reads them there.
"""

# numba is only partly typed.
# mypy: allow-untyped-calls, allow-untyped-decorators, allow-subclassing-any, disable-error-code="override"

import hashlib
from typing import Any

import numpy as np
from numba import from_dtype, types
from numba.core import cgutils
from numba.core.typing.templates import AttributeTemplate
from numba.extending import (
    NativeValue,
    infer_getattr,
    lower_getattr_generic,
    models,
    register_model,
    typeof_impl,
    unbox,
)
from numba.np.arrayobj import make_array, populate_array

WORD = 8  # bytes


class BlockType(types.Type):
    """Fields of a block, in their order: name and type."""

    def __init__(self, fields: tuple[tuple[str, Any], ...]) -> None:
        self.fields = dict(fields)
        self.word: dict[str, int] = {}  # at which the field begins
        at = 0
        for name, kind in fields:
            self.word[name] = at
            at += 1 + getattr(kind, "ndim", 0)
        digest = hashlib.blake2b(repr(fields).encode(), digest_size=8).hexdigest()
        super().__init__(name=f"Block({digest})")


class Block:
    """The fields of a named tuple: C-contiguous arrays, ints and floats. They live as long as it does."""

    def __init__(self, fields: Any) -> None:
        self.fields = fields
        words: list[int] = []
        kinds: list[tuple[str, Any]] = []
        for name, value in zip(getattr(fields, "_fields", ()), fields, strict=True):
            if isinstance(value, np.ndarray):
                if not value.flags.c_contiguous:
                    raise ValueError(f"{name} is not C-contiguous")
                kinds.append((name, types.Array(from_dtype(value.dtype), value.ndim, "C")))
                words += [value.ctypes.data, *value.shape]
            elif isinstance(value, (int, np.integer)):
                kinds.append((name, types.int64))
                words.append(int(value))
            else:
                kinds.append((name, types.float64))
                words.append(int(np.float64(value).view(np.int64)))
        self.kind = BlockType(tuple(kinds))
        self._words = np.array(words, np.int64)
        self.address = self._words.ctypes.data


register_model(BlockType)(models.OpaqueModel)


@typeof_impl.register(Block)
def _typeof(block: Block, _context: Any) -> BlockType:
    return block.kind


@unbox(BlockType)
def _unbox(_kind: BlockType, block: Any, c: Any) -> Any:
    address = c.pyapi.object_getattr_string(block, "address")
    pointer = c.pyapi.long_as_voidptr(address)
    c.pyapi.decref(address)
    return NativeValue(pointer)


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

    def word(at: int, what: Any) -> Any:
        place = builder.bitcast(cgutils.gep_inbounds(builder, block, WORD * (kind.word[name] + at)), what.as_pointer())
        read = builder.load(place)
        read.set_metadata("invariant.load", builder.module.add_metadata([]))
        return read

    if not isinstance(field, types.Array):
        return word(0, context.get_value_type(field))
    item = context.get_abi_sizeof(context.get_data_type(field.dtype))
    size = context.get_value_type(types.intp)
    shape = [word(1 + k, size) for k in range(field.ndim)]
    strides = [size(item)]
    for each in shape[:0:-1]:
        strides.insert(0, builder.mul(strides[0], each))
    array = make_array(field)(context, builder)
    data = word(0, context.get_data_type(field.dtype).as_pointer())
    populate_array(array, data=data, shape=shape, strides=strides, itemsize=item, meminfo=None)
    return array._getvalue()  # noqa: SLF001 -- so it is meant
