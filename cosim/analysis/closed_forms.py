"""Closed forms and simple integrations for comparison with runs; NumPy only, independent of the platform.

Conventions: T period, s; v, w the leader's speeds; L, L' longitudinal and lateral offset of a follower with its handle at L;
equation numbers are those of Toh 2012.
"""

import math

import numpy as np

from vcmvsp.cosim.types import Array


def circle(radius: float, speed: float, aside: float, ahead: float) -> tuple[float, float, float]:
    """Radius (m), distance to its leader (m) and speed (m/s) of a follower on a circle, with its handle at L.

    ``sin thb = L w / (v + L' w)``; the robot's centre runs on ``sqrt((R + L')^2 - L^2)``; ``rho^2 = 1 - 2 L L' sin thb``.
    """
    rate = speed / radius
    own = math.sqrt((radius + aside) ** 2 - ahead**2)
    sine = ahead * rate / (speed + aside * rate)
    rho = math.sqrt(ahead**2 + aside**2 - 2.0 * ahead * aside * sine)
    return own, rho, rate * own


def circle_distance(radius: float, speed: float, aside: float, ahead: float, handle: float) -> float:
    """Distance (m) of a follower on a circle to its leader, with any handle: ``A sin thb + B cos thb = ell w``."""
    rate = speed / radius
    across, along = speed + aside * rate, rate * (handle - ahead)  # A, B
    thb = math.asin(handle * rate / math.hypot(across, along)) - math.atan2(along, across)
    x = handle - ahead - handle * math.cos(thb)
    y = -aside + handle * math.sin(thb)
    return math.hypot(x, y)


def servo_step(gain: float, period_s: float, lag_s: float, count: int) -> Array:
    """z1 (count,) from a start one metre behind, at the leader's speed: sampled at T, speed as a first-order servo.

    State ``(z1, v_f - v_l)``; without lag it is ``(1 - k1 T)^n``.
    """
    decay = math.exp(-period_s / lag_s) if lag_s else 0.0
    way = lag_s * (1.0 - decay)
    matrix = np.array([[1.0 - gain * (period_s - way), -way], [(1.0 - decay) * gain, decay]])
    state, z = np.array([1.0, 0.0]), []
    for _ in range(count):
        z.append(state[0])
        state = matrix @ state
    return np.array(z)


def servo_overshoot(gain: float, lag_s: float) -> float:
    """The overshoot for T towards 0: ``exp(-pi zeta / sqrt(1 - zeta^2))`` with ``zeta = 1 / (2 sqrt(k1 tau))``."""
    zeta = 0.5 / math.sqrt(gain * lag_s)
    return math.exp(-math.pi * zeta / math.sqrt(1.0 - zeta * zeta)) if zeta < 1.0 else 0.0


def side_steps(gain: float, period_s: float, handle: float, speed: float, count: int) -> Array:
    """z2 (count,) from a start one metre to the side, small angles, no lag: the exact map of (z2, heading) over a period.

    ``ell w = -(v th + k2 h)``, ``h+ = h + v T th + (v T / 2 + ell) T w``, ``th+ = th + T w``; it is stable for
    ``k2 < 2 / T - v / ell``.
    """
    h, th, z = 1.0, 0.0, []
    for _ in range(count):
        z.append(h)
        w = -(speed * th + gain * h) / handle
        h, th = h + speed * period_s * th + (0.5 * speed * period_s + handle) * period_s * w, th + period_s * w
    return np.array(z)


def start_up(
    behind: float, lag_s: float, accel: float, *, gain: float, speed: float, period_s: float, first_tick: int
) -> Array:
    """z1 (m,) at each period for 20 s, of a follower at rest whose leader starts at once: integrated at 1 ms.

    It starts ``behind`` (m) its slot, with k1 = ``gain`` (1/s), a servo of ``lag_s``, acceleration at most ``accel`` (m/s2),
    braking at most 0.75 m/s2, speed at most 0.75 m/s; reports of its leader, one tick old, arrive from ``first_tick`` on.
    """
    z, own, command, z_by_period = behind, 0.0, 0.0, []
    each = round(period_s * 1000.0)
    for step in range(20_000):
        if step % each == 0:
            z_by_period.append(z)
            if step // each >= first_tick:
                command = min(speed + gain * z, 0.75)
        own = command if lag_s == 0.0 else own + 1e-3 * max(-0.75, min((command - own) / lag_s, accel))
        z += 1e-3 * (speed - own)
    return np.array(z_by_period)


def lag_behind(speed: float, gain: float, period_s: float, age_s: float, probability: float) -> tuple[float, float]:
    """Mean and root mean square of ``|z|`` (m) on a straight line with ``hold``: independent losses p, age d without loss.

    ``v (d + T p / (1 - p))``, and the variance
    ``v^2 (k1 T)^2 / (1 - a^2) T^2 p / (1 - p)^2 (1 + a p) / (1 - a p)`` with ``a = 1 - k1 T``.
    """
    p, a = probability, 1.0 - gain * period_s
    mean = speed * (age_s + period_s * p / (1.0 - p))
    spread = (speed * gain * period_s * period_s) ** 2 / (1.0 - a * a) * p / (1.0 - p) ** 2 * (1.0 + a * p) / (1.0 - a * p)
    return mean, math.sqrt(mean * mean + spread)


def hop_gain(omega: Array, gain: float, lag_s: float, delay_s: float, way: str) -> Array:
    """Gain of a follower's sway over its predecessor's: ``|N(s)| / |tau s^2 + s + k|`` at ``s = j omega`` (rad/s).

    For age d of the predecessor's reports and the way: ``hold`` (N = s + k), ``dr`` ((1 + k d) s + k), ``none`` (speed unused:
    k), ``acceleration`` (fed forward with factor tau: tau s^2 + s + k).
    """
    s = 1j * np.asarray(omega)
    numerator = {
        "hold": s + gain,
        "dr": (1.0 + gain * delay_s) * s + gain,
        "none": gain + 0.0 * s,
        "acceleration": lag_s * s**2 + s + gain,
    }[way]
    return np.asarray(np.abs(numerator) / np.abs(lag_s * s**2 + s + gain))
