"""What all values are made of: numbers within limits, vectors, arrays, and their base."""

from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import DTypeLike, NDArray

Vec3 = tuple[float, float, float]
ORIGIN: Vec3 = (0.0, 0.0, 0.0)
Array = NDArray[Any]

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
Decibels = Annotated[float, msgspec.Meta(ge=-400, le=400)]  # dB, dBm or dBi
Spread = Annotated[float, msgspec.Meta(ge=0, le=100)]  # dB
Count = Annotated[int, msgspec.Meta(ge=0)]
Seed = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
Seconds = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Period = Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]  # s
Rate = Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]  # Hz
OnLost = Literal["stop", "hold", "remove"]
FileName = Annotated[str, msgspec.Meta(extra={"file": True})]
"""The name of a file; in a scenario relative to its folder. ``pathlib.Path`` is one, too."""
Name = Annotated[str, msgspec.Meta(pattern=r"\A[A-Za-z0-9_-]+\Z")]


class Value(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """Base of all values: immutable and encodable (see `cosim.util.codec`)."""


def frozen(array: object, dtype: DTypeLike | None = None) -> Array:
    """A C-contiguous, read-only array of this content: a copy, unless it is one already."""
    if (
        isinstance(array, np.ndarray)
        and not array.flags.writeable
        and array.flags.c_contiguous
        and dtype in (None, array.dtype)
    ):
        return array
    result: Array = np.array(array, dtype, order="C")
    result.flags.writeable = False
    return result
