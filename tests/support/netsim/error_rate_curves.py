"""Reading curves of error rates."""

import numpy as np

from vcmvsp.netsim.interfaces.layers import Floats
from vcmvsp.netsim.phy.error_rate import ErrorRate


def sinr_for(errors: ErrorRate, bits: int, success: float) -> float:
    grid = np.arange(-10.0, 30.0, 0.002)
    return float(np.interp(success, errors.success(grid, bits), grid))


def array(*values: float) -> Floats:
    return np.array(values)
