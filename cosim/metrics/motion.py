"""Where the vehicles were: the table of states as dense arrays."""

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from vcmvsp.cosim.tables.columns import names_of, numbers
from vcmvsp.cosim.types import Array


@dataclass(frozen=True)
class Motion:
    """The recorded poses of m instants and n vehicles; NaN where a vehicle was not there."""

    time_ns: Array  # (m,)
    names: tuple[str, ...]
    position: Array  # (3, m, n) m, world
    yaw: Array  # (m, n) rad

    def column(self, name: str) -> int:
        """Which column belongs to a vehicle."""
        return self.names.index(name)


def motion(states: pa.Table) -> Motion:
    """The table of states as dense arrays."""
    names, code = names_of(states, "vehicle")
    times, instant = np.unique(numbers(states, "time_ns"), return_inverse=True)

    def dense(values: Array) -> Array:
        result = np.full((len(times), len(names)), np.nan)
        result[instant, code] = values
        return result

    w, x, y, z = (numbers(states, name) for name in ("qw", "qx", "qy", "qz"))
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    position = np.stack([dense(numbers(states, name)) for name in ("x", "y", "z")])
    return Motion(times, names, position, dense(yaw))
