"""Laws of quadrotors in flight, in numbers: autopilot, rotors, air and rigid body, one vehicle after the other.

Rigid body (`move`), the semi-implicit Euler method of Bullet for a free body, so that a vehicle may change over at any step:

    rate += dt J^-1 (torque - rate x J rate)      velocity += dt (force / m + g)      position += dt velocity
    attitude = attitude exp(dt rate / 2)

(All in the body's frame, where the new rate is the same before and after the rotation about it. Bullet also cuts rates to
100 rad/s and turns to 45 degrees a step, which quadrotors do not reach.)

Rotor speeds follow the autopilot with a first-order lag; thrust and drag torque grow with their squares. The air adds a force
of ``drag`` times the airspeed along each axis of the body. Gyroscopic torques of the rotors are left out.

Autopilot, a cascade, from the outside inwards:

1. Way-point (`approach`, 60 Hz): a velocity straight towards the way-point, from which braking stops there: proportional to the
   distance d close to it, sqrt(2 a (d - d0)) further away, with d0 such that both have the same slope where they meet.
2. Velocity (`guide`, 60 Hz): a PI law demands an acceleration, which the limits of thrust and then of tilt cut. The integral
   takes the error against the answer of the proportional law alone, so that steps do not overshoot; it stands still while tilt
   is at its limit (conditional integration: Astrom and Hagglund, "PID Controllers", 3.5) and has limits of its own. With
   gravity added, the direction of the acceleration is the desired thrust axis, its vertical part the lift.
3. Attitude (`steer`, every step): a rate about the axis of the shortest rotation from the thrust axis to the desired one,
   2 k sin(a/2) for its angle a: the law of Brescianini, Hehn and D'Andrea, "Nonlinear quadrocopter attitude control" (ETH
   Zurich 2013). It is strongest upside down, where the usual error vee(Rd' R - R' Rd)/2 = sin a vanishes. Heading (`turn`) has
   a weaker loop of its own, since tilt matters more (Brescianini and D'Andrea, "Tilt-prioritized quadrocopter attitude
   control", 2020).
4. Rates (`steer`, every step): torque = J k (desired - rate) + rate x J rate.
5. Mixer (`mixed`, every step): the thrust of each rotor. Forward takes more behind, left more on the right (Toh 2012, 2.5.4 has
   both the other way round). With rotors as an x the torque is first turned into their cross. Under saturation, roll and pitch
   get their share first, then lift, then yaw; a tenth is reserved for yaw, since a spinning quadrotor cannot turn upright.

The code runs interpreted or compiled (`cosim.compiled`), with the same operations in the same order: results are equal to the
last bit. All state is in a `FleetState`: a row for each component, a column for each vehicle. Loops without calls of the C
library and without further loops are compiled for several vehicles at once. NumPy's arctan2 and exp2 differ from those of
other libraries in the last bit: `run` returns where their values are needed.
"""

from math import cos, sin, sqrt
from typing import Annotated, NamedTuple

from vcmvsp.cosim.types import Array

Row = Array
"""(n,): a number for each vehicle."""
Rows = tuple[Row, ...]
"""A row for each component."""
Pair = Annotated[Rows, 2]
Three = Annotated[Rows, 3]
Four = Annotated[Rows, 4]

INLINE = True  # see `cosim.compiled.machine_code`
LOOP_HZ = 60.0  # of way-points and velocities; slower where steps are longer

# Values of `run`: what to compute before it is called again.
DONE, HEADINGS, DOWNWASH = 0, 1, 2

# Values of ``steps`` beside numbers of steps: half of one.
PUSH, MOVE = 0, -1

# Numbers in `FleetState.counts`.
FLOWN = 0  # steps of the last call
STAGE = 1  # what the caller has computed for this step: `DONE` (nothing), `HEADINGS` or `DOWNWASH`

# Numbers in `FleetState.clock`, s.
STEP, ELAPSED = 0, 1  # the step; the time since the last run of the outer loops

_EARLY_S = 1e-9  # of rounding, where steps add up to a period
_LEASH_RAD = 0.5  # greatest lead of the desired heading over the heading
_UPRIGHT = 0.5  # cosine of the tilt from which turning upright has priority over lift
_OVERHEAD = 1e-4  # 1 + the cosine at which it counts as upside down
_TINY = 1e-12
_TINIEST = 1e-300
_TUMBLING = 0.5  # rad/s2, by which rates change without any torque
_ROUNDS = 5  # each brings the middle of a step nearer by dt times the rate at which the axis turns
_TURN = 6.283185307179586
_ROUNDER = 6755399441055744.0  # 1.5 * 2^52: a number of less than 2^51 loses its fraction when this is added
_NEAREST = 0.5  # rotor radii
_EIGHTH = sqrt(0.5)  # sine and cosine of an eighth of a turn


class FleetState(NamedTuple):
    """State of n quadrotors."""

    clock: Array
    counts: Array
    # Rigid bodies
    position: Three  # m, world
    velocity: Three  # m/s, world
    velocity_before: Three  # m/s, world, before the last step
    attitude: Four  # w, x, y, z; world_from_body; unit norm
    rate: Three  # rad/s, body
    rotor: Four  # rad/s: front, left, back, right; in an x frame these are front right, front left, back left, back right
    driven: Row  # 1: rotor speeds approach `rotor_wanted`; 0: those of the autopilot
    rotor_wanted: Four  # rad/s
    # Around them
    wind: Three  # m/s, world
    down: Row  # m/s, downwash
    force: Three  # N, world, without gravity
    torque: Three  # N m, world
    lift: Row  # N, of all four rotors
    # Commands
    velocity_wanted: Three  # m/s, world
    yaw_rate_wanted: Row  # rad/s
    to_place: Row  # 1: to the way-point; 0: the velocity
    place: Three  # m, world, of the way-point
    speed: Row  # m/s, at most, to the way-point
    yaw: Row  # rad, at the way-point
    # Outer loops
    facing: Pair  # x and y of the body's forward axis
    heading_now: Row  # rad, its angle
    trim: Three  # m/s2, the integral
    reference: Three  # m/s, the answer of the proportional law alone
    axis: Three  # desired thrust axis
    lift_wanted: Row  # N
    turn: Row  # rad/s, desired
    heading: Row  # rad, desired
    cos: Row  # of it
    sin: Row
    # Of one step
    moment: Three  # N m, body
    spin: Row  # rad/s
    half_turn: Row  # rad
    cos_half: Row
    sin_half: Row


class FleetModel(NamedTuple):
    """Constants of n quadrotors."""

    gravity: float  # m/s2
    autopilot_gravity: float  # m/s2, never 0
    washed: int  # 1: the downwash of other rotors acts
    # Rigid bodies and rotors
    mass: Row  # kg
    flexibility: Three  # 1/(kg m2), one over the principal moments of inertia
    gyration: Three  # kg m2, differences of moments
    thrust_factor: Row
    follow: Row  # share of the rotors' lag that a step makes up for
    arm: Row  # m
    yaw_arm: Row  # m
    crossed: Row  # 1: rotors as an x, i.e. turned clockwise by an eighth of a turn; 0: as a plus
    resistance: Three  # N s/m
    ground_radius: Row  # m, of rotors with ground effect; 0: without
    # Limits
    max_climb: Row
    max_yaw_rate: Row
    tan_tilt: Row
    sideways: Row  # m/s2, at the greatest tilt with constant height
    most_up: Row  # m/s2, with gravity
    most_up_squared: Row
    least_up: Row
    most_trim: Three
    least_trim: Three
    # Gains
    gain_squared: Row
    knee: Row  # m, distance at which the braking law begins
    braking: Row
    velocity_gain: Row
    integral: Row
    attitude_gain: Row
    yaw_gain: Row
    stiffness: Three
    # Mixer
    most: Row  # N, of a rotor
    most_pair: Row
    yaw_reserve: Row
    rotor_share: Three  # 1/m
    per_newton: Row


def run(s: FleetState, m: FleetModel, steps: int) -> int:
    """Fly ``steps`` steps; with `PUSH` compute forces alone, with `MOVE` move all by the forces that stand.

    Returns `DONE`, or the input that the step after ``counts[FLOWN]`` steps needs from the caller.
    """
    s.counts[FLOWN] = 0
    if steps == MOVE:
        move(s, m)
        return DONE
    while True:
        missing = push(s, m)
        if missing != DONE or steps == PUSH:
            return missing
        move(s, m)
        s.counts[FLOWN] += 1
        if s.counts[FLOWN] >= steps:
            return DONE


def push(s: FleetState, m: FleetModel) -> int:
    """Advance autopilots and rotors by a step, and compute forces and torques; returns what is missing."""
    if s.counts[STAGE] == DONE and s.clock[ELAPSED] > 1.0 / LOOP_HZ - _EARLY_S:
        face(s)
        return HEADINGS
    if s.counts[STAGE] == HEADINGS:
        guide(s, m)
        turn(s, m)
        s.clock[ELAPSED] = 0.0
    if s.counts[STAGE] != DOWNWASH:
        s.clock[ELAPSED] += s.clock[STEP]
        spin_rotors(s, m)
        if m.washed:
            weigh(s, m)
            return DOWNWASH
    load(s, m)
    s.counts[STAGE] = DONE
    return DONE


def move(s: FleetState, m: FleetModel) -> None:
    """Move all as free bodies by a step, under gravity, force and torque."""
    accelerate(s, m)
    for k in range(len(s.spin)):
        s.cos_half[k], s.sin_half[k] = cos(s.half_turn[k]), sin(s.half_turn[k])
    rotate(s)


def least(a: float, b: float) -> float:
    """The smaller of two numbers."""
    return a if a < b else b  # noqa: FURB136 -- what calls min takes three times as long


def most(a: float, b: float) -> float:
    """The greater of two numbers."""
    return a if a > b else b  # noqa: FURB136


def length(x: float, y: float, z: float) -> float:
    """Length of a vector."""
    return sqrt(x * x + y * y + z * z)


def wrapped(angle: float) -> float:
    """The angle in [-pi, pi]."""
    return angle - _TURN * rounded(angle / _TURN)


def rounded(x: float) -> float:
    """The nearest whole number, the even one of two; for less than 2^51."""
    return (x + _ROUNDER) - _ROUNDER


Matrix = tuple[float, float, float, float, float, float, float, float, float]
Vector = tuple[float, float, float]
Pairs = tuple[float, float]


def rotation(attitude: Rows, k: int) -> Matrix:
    """Rotation matrix of vehicle k, world_from_body, row by row."""
    w, x, y, z = attitude[0][k], attitude[1][k], attitude[2][k], attitude[3][k]
    w2, x2, y2 = w + w, x + x, y + y
    ww, wx, wy, wz = w2 * w, w2 * x, w2 * y, w2 * z
    xy, xz, yz = x2 * y, x2 * z, y2 * z
    return (
        ww + x2 * x - 1.0,
        xy - wz,
        xz + wy,
        xy + wz,
        ww + y2 * y - 1.0,
        yz - wx,
        xz - wy,
        yz + wx,
        ww + (z + z) * z - 1.0,
    )


def into_body(r: Matrix, x: float, y: float, z: float) -> Vector:
    """A vector of the world frame in the body frame."""
    return (
        r[0] * x + r[3] * y + r[6] * z,
        r[1] * x + r[4] * y + r[7] * z,
        r[2] * x + r[5] * y + r[8] * z,
    )


def into_world(r: Matrix, x: float, y: float, z: float) -> Vector:
    """A vector of the body frame in the world frame."""
    return (
        r[0] * x + r[1] * y + r[2] * z,
        r[3] * x + r[4] * y + r[5] * z,
        r[6] * x + r[7] * y + r[8] * z,
    )


# --- autopilot, outer loops ---


def face(s: FleetState) -> None:
    """Directions of the bodies' forward axes."""
    facing_x, facing_y = s.facing
    for k in range(len(facing_x)):
        r = rotation(s.attitude, k)
        facing_x[k], facing_y[k] = r[0], r[3]


def guide(s: FleetState, m: FleetModel) -> None:
    """From commands to thrust axes and lifts."""
    elapsed_s = s.clock[ELAPSED]
    for k in range(len(s.lift)):
        want_x, want_y, want_z = approach(s, m, k)
        velocity_x, velocity_y, velocity_z = s.velocity[0][k], s.velocity[1][k], s.velocity[2][k]
        gain, trim_x, trim_y, trim_z = m.velocity_gain[k], s.trim[0][k], s.trim[1][k], s.trim[2][k]
        demand_x, demand_y = gain * (want_x - velocity_x) + trim_x, gain * (want_y - velocity_y) + trim_y
        up = most(gain * (want_z - velocity_z) + trim_z + m.autopilot_gravity, m.least_up[k])
        up = least(up, m.most_up[k])
        sideways = sqrt(demand_x * demand_x + demand_y * demand_y)
        limit = least(m.tan_tilt[k] * up, sqrt(most(m.most_up_squared[k] - up * up, _TINY)))
        scale = limit / most(sideways, limit)
        x, y = demand_x * scale, demand_y * scale
        size = length(x, y, up)
        s.lift_wanted[k] = m.mass[k] * up
        s.axis[0][k], s.axis[1][k], s.axis[2][k] = clear_axis(s, k, x / size, y / size, up / size)

        reference_x, reference_y, reference_z = s.reference[0][k], s.reference[1][k], s.reference[2][k]
        change_x, change_y = gain * (want_x - reference_x), gain * (want_y - reference_y)
        change_z = gain * (want_z - reference_z)
        share = elapsed_s * m.sideways[k] / most(length(change_x, change_y, change_z), m.sideways[k])
        reference_x += change_x * share
        reference_y += change_y * share
        reference_z += change_z * share
        s.reference[0][k], s.reference[1][k], s.reference[2][k] = reference_x, reference_y, reference_z
        free = 1.0 if sideways <= limit else 0.0
        rise = elapsed_s * m.integral[k]
        trim_x += rise * ((reference_x - velocity_x) * free)
        trim_y += rise * ((reference_y - velocity_y) * free)
        trim_z += rise * (reference_z - velocity_z)
        s.trim[0][k] = least(most(trim_x, m.least_trim[0][k]), m.most_trim[0][k])
        s.trim[1][k] = least(most(trim_y, m.least_trim[1][k]), m.most_trim[1][k])
        s.trim[2][k] = least(most(trim_z, m.least_trim[2][k]), m.most_trim[2][k])


def clear_axis(s: FleetState, k: int, x: float, y: float, z: float) -> Vector:
    """The desired thrust axis; where it is opposite to the present one, no rotation is the shortest: one is chosen."""
    r = rotation(s.attitude, k)
    if x * r[2] + y * r[5] + z * r[8] < _OVERHEAD - 1.0:
        x, y, z = x + 0.1 * r[0], y + 0.1 * r[3], z + 0.1 * r[6]
    return x, y, z


def approach(s: FleetState, m: FleetModel, k: int) -> Vector:
    """The desired velocity: as commanded, or towards the way-point."""
    x, y, z = s.place[0][k] - s.position[0][k], s.place[1][k] - s.position[1][k], s.place[2][k] - s.position[2][k]
    distance = length(x, y, z)
    # Both laws have the same value and slope at the knee; elsewhere this one is lower.
    near, beyond = least(distance, m.knee[k]), most(distance - m.knee[k], 0.0)
    speed = sqrt(m.gain_squared[k] * near * near + m.braking[k] * (beyond + beyond))
    scale = least(speed, s.speed[k]) / most(distance, _TINY)
    x, y, z = x * scale, y * scale, z * scale
    slower = m.max_climb[k] / most(abs(z), m.max_climb[k])
    wanted_x, wanted_y, wanted_z = s.velocity_wanted[0][k], s.velocity_wanted[1][k], s.velocity_wanted[2][k]
    if s.to_place[k] == 0.0:
        return wanted_x, wanted_y, wanted_z
    return x * slower, y * slower, z * slower


def turn(s: FleetState, m: FleetModel) -> None:
    """Turn the desired heading: at the commanded rate, or towards the heading of the way-point."""
    elapsed_s = s.clock[ELAPSED]
    for k in range(len(s.lift)):
        rest = m.yaw_gain[k] * wrapped(s.yaw[k] - s.heading[k])
        rest = least(most(rest, -m.max_yaw_rate[k]), m.max_yaw_rate[k])
        rate = s.turn[k] + elapsed_s * m.yaw_gain[k] * (s.yaw_rate_wanted[k] - s.turn[k])
        rate = rate if s.to_place[k] == 0.0 else rest
        ahead = wrapped(s.heading[k] + rate * elapsed_s - s.heading_now[k])
        s.turn[k] = rate
        s.heading[k] = s.heading_now[k] + least(most(ahead, -_LEASH_RAD), _LEASH_RAD)
    for k in range(len(s.lift)):
        s.cos[k], s.sin[k] = cos(s.heading[k]), sin(s.heading[k])


# --- autopilot, inner loops; rotors ---


def spin_rotors(s: FleetState, m: FleetModel) -> None:
    """From thrust axes and lifts to rotor speeds."""
    front, left, back, right = s.rotor
    for k in range(len(s.lift)):
        x, y, z, thrust = steer(s, m, k)
        x, y = turned_in(m, k, x, y)
        a, b, c, d = mixed(m, k, x, y, z, thrust)
        driven = s.driven[k] != 0.0
        a = s.rotor_wanted[0][k] if driven else a
        b = s.rotor_wanted[1][k] if driven else b
        c = s.rotor_wanted[2][k] if driven else c
        d = s.rotor_wanted[3][k] if driven else d
        front[k] += m.follow[k] * (a - front[k])
        left[k] += m.follow[k] * (b - left[k])
        back[k] += m.follow[k] * (c - back[k])
        right[k] += m.follow[k] * (d - right[k])


def turned_in(m: FleetModel, k: int, x: float, y: float) -> Pairs:
    """Horizontal components along the arms of the first two rotors' cross, of a vector in the body frame."""
    crossed = m.crossed[k] != 0.0
    along = (x - y) * _EIGHTH if crossed else x
    across = (x + y) * _EIGHTH if crossed else y
    return along, across


def turned_out(m: FleetModel, k: int, x: float, y: float) -> Pairs:
    """The inverse of `turned_in`."""
    crossed = m.crossed[k] != 0.0
    ahead = (x + y) * _EIGHTH if crossed else x
    left = (y - x) * _EIGHTH if crossed else y
    return ahead, left


def weigh(s: FleetState, m: FleetModel) -> None:
    """Lifts of the rotors."""
    for k in range(len(s.lift)):
        a, b, c, d = thrusts(s, m, k)
        s.lift[k] = a + b + c + d


def steer(s: FleetState, m: FleetModel, k: int) -> tuple[float, float, float, float]:
    """Torque, N m, body, and thrust, N, for the desired axis and heading."""
    r = rotation(s.attitude, k)
    axis_x, axis_y, axis_z = into_body(r, s.axis[0][k], s.axis[1][k], s.axis[2][k])
    rate_x, rate_y, rate_z = s.rate[0][k], s.rate[1][k], s.rate[2][k]
    stiff = m.attitude_gain[k] * sqrt(2.0 / most(axis_z + 1.0, _OVERHEAD))
    want_z = s.turn[k] + m.yaw_gain[k] * (s.sin[k] * r[0] - s.cos[k] * r[3])
    x = m.stiffness[0][k] * (-stiff * axis_y - rate_x) + m.gyration[0][k] * (rate_y * rate_z)
    y = m.stiffness[1][k] * (stiff * axis_x - rate_y) + m.gyration[1][k] * (rate_z * rate_x)
    z = m.stiffness[2][k] * (want_z - rate_z) + m.gyration[2][k] * (rate_x * rate_y)
    upright = most(r[8], _UPRIGHT)
    return x, y, z, s.lift_wanted[k] * most(r[8], 0.0) / (upright * upright)


def mixed(m: FleetModel, k: int, x: float, y: float, z: float, thrust: float) -> tuple[float, float, float, float]:
    """Rotor speeds, rad/s, for torque, N m, body, and thrust, N: front, left, back, right."""
    greatest, pair = m.most[k], m.most_pair[k]
    x, y, z = x * m.rotor_share[0][k], y * m.rotor_share[1][k], z * m.rotor_share[2][k]  # N: right to left, front to back
    reach = most(abs(x), abs(y))
    scale = pair / most(reach, pair)
    x, y = x * scale, y * scale
    reach = least(reach, pair)
    floor = reach + least(abs(z), m.yaw_reserve[k])
    base = least(most(0.25 * thrust, floor), greatest - floor)
    room = least(base, greatest - base) - reach
    z = least(most(z, -room), room)
    per_newton = m.per_newton[k]
    return (
        sqrt(most((base - z - y) * per_newton, 0.0)),
        sqrt(most((base + z + x) * per_newton, 0.0)),
        sqrt(most((base - z + y) * per_newton, 0.0)),
        sqrt(most((base + z - x) * per_newton, 0.0)),
    )


def thrusts(s: FleetState, m: FleetModel, k: int) -> tuple[float, float, float, float]:
    """Thrust of each rotor, N, with the ground effect (`physics.dynamics.wind`)."""
    front, left, back, right = s.rotor[0][k], s.rotor[1][k], s.rotor[2][k], s.rotor[3][k]
    factor, rise = m.thrust_factor[k], ground_effect(s.position[2][k], m.ground_radius[k])
    return (
        factor * front * front * rise,
        factor * left * left * rise,
        factor * back * back * rise,
        factor * right * right * rise,
    )


# --- air and rigid body ---


def ground_effect(height: float, rotor_radius: float) -> float:
    """Factor of the thrust at a height above the floor, m; 1 for a radius of 0.

    The air under a rotor of radius R at height z cannot flow off freely, which gives it 1 / (1 - (R / 4z)^2) times the thrust
    (Cheeseman and Bennett, "The effect of the ground on a helicopter rotor in forward flight", ARC R&M 3021, 1955); below
    z = R/2 the factor is constant. Only the floor counts (z = 0), not roofs and tables.
    """
    if rotor_radius == 0.0:
        return 1.0
    quarter = 0.25 * rotor_radius / most(height, _NEAREST * rotor_radius)
    return 1.0 / (1.0 - quarter * quarter)


def load(s: FleetState, m: FleetModel) -> None:
    """Forces and torques of rotors and air."""
    for k in range(len(s.lift)):
        r = rotation(s.attitude, k)
        front, left, back, right = thrusts(s, m, k)
        pitching, rolling = front + back, left + right
        down = s.velocity[2][k] - s.wind[2][k]
        if m.washed:
            down += s.down[k]
        x, y, z = into_body(r, s.velocity[0][k] - s.wind[0][k], s.velocity[1][k] - s.wind[1][k], down)
        x, y, z = m.resistance[0][k] * x, m.resistance[1][k] * y, m.resistance[2][k] * z + (pitching + rolling)
        s.force[0][k], s.force[1][k], s.force[2][k] = into_world(r, x, y, z)
        s.moment[0][k], s.moment[1][k] = turned_out(m, k, m.arm[k] * (left - right), -m.arm[k] * (front - back))
        s.moment[2][k] = m.yaw_arm[k] * (rolling - pitching)
    for k in range(len(s.lift)):
        x, y, z = precession(s, m, k)
        s.moment[0][k] += x
        s.moment[1][k] += y
        s.moment[2][k] += z
    for k in range(len(s.lift)):
        r = rotation(s.attitude, k)
        s.torque[0][k], s.torque[1][k], s.torque[2][k] = into_world(r, s.moment[0][k], s.moment[1][k], s.moment[2][k])


def precession(s: FleetState, m: FleetModel, k: int) -> Vector:
    """Torque, N m, body, that turns Bullet's step into an implicit midpoint step; 0 for a body that hardly tumbles.

    Bullet takes ``rate x J rate`` at the beginning of a step, which adds energy and angular momentum to a body that spins about
    more than one axis. The midpoint rule conserves both, as it does all quadratic invariants (E. Hairer, C. Lubich, G. Wanner,
    Geometric numerical integration, 2006, IV.2.1). ``FleetState.moment`` has the torque of all other causes.
    """
    rate_x, rate_y, rate_z = s.rate[0][k], s.rate[1][k], s.rate[2][k]
    gyration_x, gyration_y, gyration_z = m.gyration[0][k], m.gyration[1][k], m.gyration[2][k]
    flexibility_x, flexibility_y, flexibility_z = m.flexibility[0][k], m.flexibility[1][k], m.flexibility[2][k]
    early_x, early_y, early_z = gyration_x * (rate_y * rate_z), gyration_y * (rate_z * rate_x), gyration_z * (rate_x * rate_y)
    tumbling = most(most(abs(flexibility_x * early_x), abs(flexibility_y * early_y)), abs(flexibility_z * early_z))
    if tumbling <= _TUMBLING:
        return 0.0, 0.0, 0.0
    x, y, z, dt = s.moment[0][k], s.moment[1][k], s.moment[2][k], s.clock[STEP]
    half_x, half_y, half_z = 0.5 * dt * flexibility_x, 0.5 * dt * flexibility_y, 0.5 * dt * flexibility_z
    middle_x, middle_y, middle_z = rate_x, rate_y, rate_z
    for _ in range(_ROUNDS):
        middle_x, middle_y, middle_z = (
            rate_x + half_x * (x - gyration_x * (middle_y * middle_z)),
            rate_y + half_y * (y - gyration_y * (middle_z * middle_x)),
            rate_z + half_z * (z - gyration_z * (middle_x * middle_y)),
        )
    return (
        early_x - gyration_x * (middle_y * middle_z),
        early_y - gyration_y * (middle_z * middle_x),
        early_z - gyration_z * (middle_x * middle_y),
    )


def accelerate(s: FleetState, m: FleetModel) -> None:
    """Velocities, positions and rates after a step, and the turn in it."""
    dt = s.clock[STEP]
    for k in range(len(s.lift)):
        r = rotation(s.attitude, k)
        x, y, z = into_body(r, s.torque[0][k], s.torque[1][k], s.torque[2][k])
        rate_x, rate_y, rate_z = s.rate[0][k], s.rate[1][k], s.rate[2][k]
        x = rate_x + m.flexibility[0][k] * (dt * (x - m.gyration[0][k] * (rate_y * rate_z)))
        y = rate_y + m.flexibility[1][k] * (dt * (y - m.gyration[1][k] * (rate_z * rate_x)))
        z = rate_z + m.flexibility[2][k] * (dt * (z - m.gyration[2][k] * (rate_x * rate_y)))
        s.rate[0][k], s.rate[1][k], s.rate[2][k] = x, y, z
        s.spin[k] = length(x, y, z)
        s.half_turn[k] = 0.5 * dt * s.spin[k]
        push_s = dt / m.mass[k]
        before_x, before_y, before_z = s.velocity[0][k], s.velocity[1][k], s.velocity[2][k]
        x, y = before_x + s.force[0][k] * push_s, before_y + s.force[1][k] * push_s
        z = before_z + s.force[2][k] * push_s - m.gravity * dt
        s.velocity_before[0][k], s.velocity_before[1][k], s.velocity_before[2][k] = before_x, before_y, before_z
        s.velocity[0][k], s.velocity[1][k], s.velocity[2][k] = x, y, z
        s.position[0][k] += x * dt
        s.position[1][k] += y * dt
        s.position[2][k] += z * dt


def rotate(s: FleetState) -> None:
    """Attitudes after a step at constant rates: the exponential map."""
    for k in range(len(s.lift)):
        a, b, c, d = s.attitude[0][k], s.attitude[1][k], s.attitude[2][k], s.attitude[3][k]
        share = s.sin_half[k] / most(s.spin[k], _TINIEST)
        w, x, y, z = s.cos_half[k], s.rate[0][k] * share, s.rate[1][k] * share, s.rate[2][k] * share
        w, x, y, z = (
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y + c * w + d * x - b * z,
            a * z + d * w + b * y - c * x,
        )
        norm = sqrt(w * w + x * x + y * y + z * z)
        s.attitude[0][k], s.attitude[1][k], s.attitude[2][k], s.attitude[3][k] = w / norm, x / norm, y / norm, z / norm
