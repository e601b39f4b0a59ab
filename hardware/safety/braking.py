"""Stopping distance of a robot, and the greatest speed for a given distance.

A command acts until the next one, ``hold`` s later; from then on the robot may have to stop at ``decel``. A robot that is
commanded v while it moves at u, all along one line, stops after ::

    v hold + v**2 / (2 decel)                              if it is not slower than before, v >= u
    v hold + v**2 / (2 decel) + (u - v)**2 / (2 decel)     if it first slows down, and reaches v within hold
    u**2 / (2 decel)                                       if it does not reach v within hold

These are times of reaction and of braking as in ISO 13855 and ISO/TS 15066, 5.5.4 (protective separation distance); without
reaction the greatest speed is that of the dynamic window, sqrt(2 decel d) [Fox, Burgard, Thrun 1997, eq. 14]. An obstacle
that approaches at c m/s adds c times the time until the robot stands, hold + v / decel; one that recedes adds nothing, as it
may stop.
"""

import math

TOLERANCE_M = 1e-9  # rounding of distances must not count as a danger


def swept(v: float, u: float, hold: float, decel: float) -> float:
    """Stopping distance (m, or rad) for speeds v, u >= 0: see above."""
    if u - v >= decel * hold:
        return u * u / (2.0 * decel)
    slowing = max(0.0, u - v)
    return v * hold + (v * v + slowing * slowing) / (2.0 * decel)


def stops_within(free: float, u: float, closing: float, decel: float) -> bool:
    """Whether a robot at u m/s that brakes at once stops within ``free`` m."""
    return u * u / (2.0 * decel) + closing * u / decel <= free + TOLERANCE_M


def fastest(free: float, u: float, closing: float, hold: float, decel: float) -> float:
    """The highest speed v (m/s) that may be commanded at u m/s, so that the robot stands within ``free`` m; 0 if none fits.

    With a = decel, T = hold, c = closing: the greater root of v**2 + 2 (a T + c) v + 2 a (c T - free) = 0 if that is
    not below u, else of 2 v**2 + 2 (a T + c - u) v + u**2 + 2 a (c T - free) = 0.
    """
    if math.isinf(free):
        return math.inf
    half, rest = decel * hold + closing, 2.0 * decel * (free - closing * hold)
    if rest <= 0.0:
        return 0.0
    v = rest / (half + math.sqrt(half * half + rest))  # the root, without a difference of nearly equal numbers
    if v >= u:
        return v
    half -= u
    square = half * half + 2.0 * (rest - u * u)
    return max(0.0, 0.5 * (math.sqrt(square) - half)) if square >= 0.0 else 0.0
