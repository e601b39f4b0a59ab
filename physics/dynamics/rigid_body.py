"""Rotations and free rigid bodies, a column each, for few NumPy calls.

Quaternions (4, n) are w, x, y, z; world_from_body.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vcmvsp.physics.world.world import pairs

Floats = NDArray[np.float64]

_W, _X, _Y, _Z = range(4)

# A rotation matrix, row by row, is the first of these doubled products plus or minus the second; and 1 less on its diagonal.
_FIRST = pairs((_W, _W), (_X, _Y), (_X, _Z), (_X, _Y), (_W, _W), (_Y, _Z), (_X, _Z), (_Y, _Z), (_W, _W))
_SECOND = pairs((_X, _X), (_W, _Z), (_W, _Y), (_W, _Z), (_Y, _Y), (_W, _X), (_W, _Y), (_W, _X), (_Z, _Z))
_SIGN = np.array([1.0, -1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0, 1.0])[:, None]

# A product of quaternions p q: each component is a sum of four products, the first three of which, but for w, are positive.
_TERMS = pairs(
    *((_W, _W), (_W, _X), (_W, _Y), (_W, _Z)),
    *((_X, _X), (_X, _W), (_Y, _W), (_Z, _W)),
    *((_Y, _Y), (_Y, _Z), (_Z, _X), (_X, _Y)),
    *((_Z, _Z), (_Z, _Y), (_X, _Z), (_Y, _X)),
)
_TERM_SIGN = np.array([[1.0, 1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0], [-1.0, -1.0, -1.0, -1.0]])[..., None]

_NEXT, _LAST = np.array([1, 2, 0]), np.array([2, 0, 1])  # axes
_TINY = 1e-300
_TUMBLING = 0.5  # rad/s2, by which rates change without any torque
_ROUNDS = 5  # each brings the middle of a step nearer by dt times the rate at which the axis turns


def rotations(attitude: Floats) -> Floats:
    """Rotation matrices (3, 3, n) of unit quaternions (4, n)."""
    n = attitude.shape[1]
    products = ((attitude + attitude)[:, None] * attitude).reshape(16, n)
    matrices = products.take(_FIRST, axis=0) + _SIGN * products.take(_SECOND, axis=0)
    matrices[::4] -= 1.0
    return matrices.reshape(3, 3, n)


def into_body(rotation: Floats, vector: Floats) -> Floats:
    """Vectors (3, n) of the world frame in the body frame."""
    terms = rotation * vector[:, None]
    return terms[0] + terms[1] + terms[2]


def turned(attitude: Floats, rate: Floats, dt: float) -> Floats:
    """Unit quaternions (4, n) after ``dt`` s at constant rates (3, n) rad/s, body: the exponential map."""
    squares = rate * rate
    speed = np.sqrt(squares[0] + squares[1] + squares[2])
    half = (0.5 * dt) * speed
    turn = np.empty_like(attitude)
    np.cos(half, out=turn[0])
    np.multiply(rate, np.sin(half) / np.maximum(speed, _TINY), out=turn[1:])
    n = attitude.shape[1]
    terms = (attitude[:, None] * turn).reshape(16, n).take(_TERMS, axis=0).reshape(4, 4, n)
    terms *= _TERM_SIGN
    after: Floats = terms[0] + terms[1] + terms[2] + terms[3]
    squares = after * after
    after /= np.sqrt(squares[0] + squares[1] + squares[2] + squares[3])
    return after


def gyration(inertia: Floats) -> Floats:
    """Factors of `coupled` that give rate x J rate, for principal moments of inertia (3, n) kg m2."""
    x, y, z = inertia
    return np.array([z - y, x - z, y - x])


def coupled(rate: Floats) -> Floats:
    """Products y z, z x and x y, (3, n) rad2/s2, of the components x, y, z of angular rates (3, n) rad/s."""
    return rate.take(_NEXT, axis=0) * rate.take(_LAST, axis=0)


def precession(rate: Floats, torque: Floats, flexibility: Floats, gyrations: Floats, dt: float) -> Floats:
    """Torques (3, n) N m, body, that turn Bullet's step into an implicit midpoint step; 0 for bodies that hardly tumble.

    Bullet takes ``rate x J rate`` at the beginning of a step, which adds energy and angular momentum to a body that spins about
    more than one axis. The midpoint rule conserves both, as it does all quadratic invariants (E. Hairer, C. Lubich, G. Wanner,
    Geometric numerical integration, 2006, IV.2.1). All arrays are (3, n), in the body's frame: ``rate`` rad/s, ``torque`` N m
    of all other causes, ``flexibility`` one over the principal moments of inertia, ``gyrations`` kg m2 (`gyration`).
    """
    early = gyrations * coupled(rate)
    tumbling = (np.abs(flexibility * early) > _TUMBLING).any(axis=0)
    if not tumbling.any():
        return np.zeros_like(rate)
    middle, half = rate, 0.5 * dt * flexibility
    for _ in range(_ROUNDS):
        middle = rate + half * (torque - gyrations * coupled(middle))
    return np.where(tumbling, early - gyrations * coupled(middle), 0.0)


def column(models: Sequence[object], name: str) -> Floats:
    """An attribute of all models, (n,)."""
    return np.array([getattr(model, name) for model in models], float)


def columns(rows: Any, size: int) -> Floats:
    """A (size, n) copy of (n, size) numbers; n may be 0."""
    return np.array(rows, float).reshape(-1, size).T.copy()
