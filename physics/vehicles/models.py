"""Vehicle models that a scenario can name, as sets of parameters; the engines implement their motion.

The position of a vehicle is that of its reference point: the middle of the wheel axle, projected onto the floor; the centre of
mass of an aerial vehicle. Rotors of a quadrotor are in plus configuration: in front (+x), left (+y), behind, right; in an x all
are an eighth of a turn further to the right. Front and back turn counter-clockwise seen from above, so that their drag turns
the body clockwise. Vehicles from a user's own files are in `physics.vehicles.urdf`. Sources:

* p2dx.p, amigo.p: robot parameter files of ARIA (ActivMedia/MobileRobots), where the effective track is 2 / DiffConvFactor.
* Stage, Gazebo: vehicle definitions of the Player/Stage and of the Gazebo simulator.
* AMRISim: vehicle definitions of the USARSim family. MobileSim: simulator of the makers of both robots.
* Manuals: masses and wheel radii of the makers' manuals as commonly quoted; not verified on a robot.
* Duffy: measurements of an F330 frame with 8 inch propellers on owenduffy.net: 0.86 kg ready to fly; 190 g of thrust from
  16.8 W at the shaft, at 4626 rpm.
* Parts: added up from the masses and places of frame, motors, battery and electronics.
* Assumed: a plausible value without a published source. Tuned: chosen for the step responses in this part's README.
"""

import math
from dataclasses import dataclass
from math import inf
from typing import Literal, NamedTuple

from vcmvsp.cosim.types import NonNegative, Positive
from vcmvsp.physics.world.solids import Hull


class Servo(NamedTuple):
    """Speeds without a body: first-order lags behind the command, within limits (`physics.dynamics.kinematic`)."""

    tau_v_s: float = 0.0  # 0: the speed is the commanded one at once
    tau_w_s: float = 0.0
    accel: float = inf  # m/s2, of a growing v
    decel: float = inf  # m/s2, of a falling v
    yaw_accel: float = inf  # rad/s2
    max_speed: float = inf  # m/s
    max_yaw_rate: float = inf  # rad/s


@dataclass(frozen=True, kw_only=True)
class GroundVehicle:
    """Base of all ground vehicles."""

    radius_m: Positive = 0.25  # of the circle that it is drawn with
    height_m: Positive = 0.22  # from its lowest to its highest point

    @property
    def servo(self) -> Servo:
        """Motion as a point: exactly as commanded, unless a kind overrides it."""
        return Servo()

    @property
    def hull(self) -> Hull:
        """Hull: a cylinder on the floor."""
        return Hull((2.0 * self.radius_m, 2.0 * self.radius_m, self.height_m), (0.0, 0.0, 0.5 * self.height_m), "cylinder")


@dataclass(frozen=True, kw_only=True)
class Kinematic(GroundVehicle):
    """The unicycle: its velocity is the command, at once and without limit."""


@dataclass(frozen=True, kw_only=True)
class Lag(GroundVehicle):
    """A unicycle with first-order lags of its speeds behind the command, s."""

    tau_v_s: NonNegative = 0.5  # lag of the forward speed
    tau_w_s: NonNegative = 0.3  # lag of the yaw rate

    @property
    def servo(self) -> Servo:
        """Motion as a point with lags, without limits."""
        return Servo(self.tau_v_s, self.tau_w_s)


@dataclass(frozen=True, kw_only=True)
class Inertial(Lag):
    """`Lag` with the limits of a small robot, an AmigoBot in MobileSim (0.75 m/s, 0.3 and 0.75 m/s2).

    ``accel`` limits a growing and ``decel`` a falling forward speed; these vehicles do not model reverse driving.
    """

    accel: Positive = 0.3  # m/s2, of a growing forward speed
    decel: Positive = 0.75  # m/s2, of a falling one
    yaw_accel: Positive = 1.5  # rad/s2, assumed
    max_speed: Positive = 0.75  # m/s
    max_yaw_rate: Positive = 1.75  # rad/s

    @property
    def servo(self) -> Servo:
        """Motion as a point with lags, within limits."""
        limits = (self.accel, self.decel, self.yaw_accel, self.max_speed, self.max_yaw_rate)
        return Servo(self.tau_v_s, self.tau_w_s, *limits)


@dataclass(frozen=True, kw_only=True)
class DifferentialDrive(GroundVehicle):
    """A robot of two driven wheels and a caster; a body in Bullet, elsewhere it moves exactly as commanded.

    The firmware moves its set points of (v, w) towards the command within the limits below; two speed-controlled motors of
    limited torque turn the wheels, and the friction between wheels and floor moves the robot.
    """

    mass_kg: Positive  # all of it, wheels included
    length_m: Positive  # of the body's outline
    width_m: Positive  # of the body's outline
    axle_ahead_m: float  # of the middle of the outline
    clearance_m: Positive  # between floor and body
    mass_behind_m: Positive  # centre of mass of the body behind the axle; less than caster_behind_m, else it tips over
    mass_height_m: Positive  # centre of mass of the body above the floor
    caster_behind_m: Positive  # behind the axle
    caster_friction: NonNegative = 0.05  # of caster and body: a caster rolls nearly without friction
    wheel_radius_m: Positive  # of the driven wheels
    wheel_mass_kg: Positive  # of each wheel
    wheel_friction: NonNegative = 0.9  # rubber on a hard floor, assumed; times the floor's
    track_m: Positive  # between the wheels' points of contact
    torque: Positive  # N m, free at each wheel
    max_speed: Positive  # m/s
    max_yaw_rate: Positive  # rad/s
    accel: Positive  # m/s2, away from standstill
    decel: Positive  # m/s2, towards standstill
    yaw_accel: Positive  # rad/s2, both ways

    def __post_init__(self) -> None:
        if 2.0 * self.wheel_mass_kg >= self.mass_kg:
            raise ValueError(f"mass_kg = {self.mass_kg} must exceed the mass of both wheels, 2 x {self.wheel_mass_kg} kg")
        if self.clearance_m >= self.height_m:
            raise ValueError(f"clearance_m = {self.clearance_m} must be less than height_m = {self.height_m}")
        if self.mass_behind_m >= self.caster_behind_m:
            raise ValueError(f"mass_behind_m = {self.mass_behind_m} must be less than caster_behind_m = {self.caster_behind_m}")

    @property
    def hull(self) -> Hull:
        """Hull: a box on the floor that contains the wheels."""
        return Hull((self.length_m, self.width_m, self.height_m), (-self.axle_ahead_m, 0.0, 0.5 * self.height_m))


@dataclass(frozen=True, kw_only=True)
class P2DX(DifferentialDrive):
    """Pioneer 2-DX."""

    radius_m: Positive = 0.25
    height_m: Positive = 0.22  # Stage
    mass_kg: Positive = 9.0  # manuals
    length_m: Positive = 0.511  # p2dx.p
    width_m: Positive = 0.425  # p2dx.p
    axle_ahead_m: float = 0.04  # Stage
    clearance_m: Positive = 0.05  # assumed
    mass_behind_m: Positive = 0.03  # assumed
    mass_height_m: Positive = 0.08  # assumed: the batteries lie low
    caster_behind_m: Positive = 0.20  # assumed
    wheel_radius_m: Positive = 0.0825  # manuals
    wheel_mass_kg: Positive = 0.4  # assumed
    track_m: Positive = 0.357  # p2dx.p; 0.33 between the middles of the tyres
    torque: Positive = 1.2  # assumed: gives 3 m/s2
    max_speed: Positive = 1.6  # AMRISim
    max_yaw_rate: Positive = 8.73  # p2dx.p: 500 deg/s
    accel: Positive = 0.3  # MobileSim
    decel: Positive = 0.6  # MobileSim
    yaw_accel: Positive = 1.75  # assumed: 100 deg/s2


@dataclass(frozen=True, kw_only=True)
class AmigoBot(DifferentialDrive):
    """AmigoBot, the small robot of Toh 2012."""

    radius_m: Positive = 0.18
    height_m: Positive = 0.15  # manuals
    mass_kg: Positive = 3.6  # manuals
    length_m: Positive = 0.330  # amigo.p
    width_m: Positive = 0.279  # amigo.p
    axle_ahead_m: float = 0.01  # Stage
    clearance_m: Positive = 0.03  # assumed
    mass_behind_m: Positive = 0.03  # assumed
    mass_height_m: Positive = 0.06  # assumed
    caster_behind_m: Positive = 0.12  # assumed
    wheel_radius_m: Positive = 0.05  # manuals
    wheel_mass_kg: Positive = 0.2  # assumed
    track_m: Positive = 0.25  # Gazebo; amigo.p gives 0.182 as effective, which the body's width contradicts
    torque: Positive = 0.35  # assumed: gives 4 m/s2
    max_speed: Positive = 1.0  # amigo.p
    max_yaw_rate: Positive = 5.24  # amigo.p: 300 deg/s
    accel: Positive = 0.3  # MobileSim
    decel: Positive = 0.75  # MobileSim
    yaw_accel: Positive = 1.75  # assumed: 100 deg/s2


@dataclass(frozen=True, kw_only=True)
class Point:
    """A vehicle in the air without a body: its velocity follows the command with a first-order lag, within its greatest speeds.

    It always stays level. On its way to a way-point it follows, with the same lag, a point that moves on a straight line at
    constant speed; near the way-point only the lag slows it down.
    """

    radius_m: Positive = 0.25  # of the cylinder that it is drawn with
    height_m: Positive = 0.1  # of that cylinder, around its position
    tau_s: NonNegative = 0.0  # s; 0: it moves exactly as commanded. 0.4 is near to the quadrotor
    max_speed: Positive = 10.0  # m/s, horizontal; assumed
    max_climb: Positive = 5.0  # m/s, up and down; assumed
    max_yaw_rate: Positive = 3.0  # rad/s; assumed

    @property
    def hull(self) -> Hull:
        """Hull: a cylinder around its position."""
        return Hull((2.0 * self.radius_m, 2.0 * self.radius_m, self.height_m), kind="cylinder")


@dataclass(frozen=True, kw_only=True)
class Quadrotor:
    """A quadrotor of the 330 class (GAUI 330X, F330), which takes velocities with a yaw rate, and way-points."""

    radius_m: Positive = 0.267  # of the cylinder around it: 0.165 m arm and half a propeller of 0.2032 m
    height_m: Positive = 0.08  # of that cylinder, which the centre of mass is in the middle of
    mass_kg: Positive = 0.80  # all of it; Duffy, with a smaller battery
    frame: Literal["plus", "x"] = "plus"  # of the rotors: first one ahead, or ahead to the right (an x; with firmware)
    arm_m: Positive = 0.165  # from the centre to each rotor: 0.33 m from motor to motor
    inertia: tuple[Positive, Positive, Positive] = (0.0040, 0.0040, 0.0073)  # kg m2, about x, y, z; parts
    rotor_radius_m: Positive = 0.1016  # half a propeller of 8 inches
    thrust_factor: Positive = 7.9e-6  # N s2/rad2: a rotor at w rad/s lifts this times w squared; Duffy
    torque_factor: Positive = 1.47e-7  # N m s2/rad2: ... and its drag turns the body with this times w squared; Duffy
    max_rotor_speed: Positive = 838.0  # rad/s; 5.5 N each, 2.8 times the weight together; assumed
    motor_lag_s: Positive = 0.05  # first-order lag of the rotor speed; assumed
    drag: tuple[NonNegative, NonNegative, NonNegative] = (0.25, 0.25, 0.35)  # N s/m, along x, y, z, against the air; assumed
    ground_effect: bool = False  # more thrust close above the floor, see `physics.dynamics.quadrotor_laws`
    downwash: bool = False  # thrust lost below other quadrotors, see `physics.dynamics.wind`

    max_speed: Positive = 8.0  # m/s, horizontal, of its autopilot; assumed
    max_climb: Positive = 3.0  # m/s, up and down; assumed
    max_yaw_rate: Positive = 2.0  # rad/s; assumed
    max_tilt_rad: Positive = 0.4363  # from upright, 25 degrees; assumed
    max_thrust: Positive = 0.9  # fraction of the rotors' thrust in steady flight: the rest is for turning; assumed
    braking: Positive = 2.0  # m/s2, planned deceleration at a waypoint; assumed
    position_gain: Positive = 0.8  # 1/s, speed towards a way-point for each metre; tuned
    velocity_gain: Positive = 3.0  # 1/s, acceleration for each m/s of error; tuned
    velocity_integral: NonNegative = 3.2  # 1/s2, what acceleration grows by for each m/s of error; tuned
    attitude_gain: Positive = 6.0  # 1/s, turning rate for each rad of error; tuned
    rate_gain: Positive = 20.0  # 1/s, turning acceleration for each rad/s of error; tuned
    yaw_gain: Positive = 3.0  # 1/s, yaw rate for each rad of error; tuned
    yaw_rate_gain: Positive = 8.0  # 1/s, yaw acceleration for each rad/s of error; tuned

    def __post_init__(self) -> None:
        if self.max_tilt_rad >= 0.5 * math.pi:
            raise ValueError(f"max_tilt_rad = {self.max_tilt_rad} must be less than a right angle")
        if self.max_thrust > 1.0:
            raise ValueError(f"max_thrust = {self.max_thrust} is a fraction of the rotors' full thrust: at most 1")

    @property
    def hull(self) -> Hull:
        """Hull: a cylinder around its centre of mass."""
        return Hull((2.0 * self.radius_m, 2.0 * self.radius_m, self.height_m), kind="cylinder")

    @property
    def max_rotor_thrust(self) -> float:
        """Greatest thrust of one rotor, N."""
        return self.thrust_factor * self.max_rotor_speed**2

    def check_lift(self, gravity: float) -> None:
        """Refuse a quadrotor that cannot hover within its own limits."""
        lift, weight = 4.0 * self.max_thrust * self.max_rotor_thrust, self.mass_kg * gravity / math.cos(self.max_tilt_rad)
        if lift <= weight:
            raise ValueError(f"{self.mass_kg} kg at max_tilt_rad need {weight:.3g} N, but the rotors lift only {lift:.3g} N")


@dataclass(frozen=True, kw_only=True)
class Crazyflie(Quadrotor):
    """A Crazyflie 2.1, 27 g.

    Datasheet: Bitcraze, "Datasheet Crazyflie 2.1". Forster: J. Forster, System identification of the Crazyflie 2.0 nano
    quadrocopter, ETH Zurich 2015. Panerati: J. Panerati et al., Learning to fly, IROS 2021, the model cf2x, whose factors are
    for revolutions per minute.
    """

    radius_m: Positive = 0.069  # arm and half a propeller
    height_m: Positive = 0.029  # datasheet
    mass_kg: Positive = 0.027  # datasheet
    frame: Literal["plus", "x"] = "x"
    arm_m: Positive = 0.046  # datasheet: 92 mm from motor to motor
    inertia: tuple[Positive, Positive, Positive] = (1.6572e-5, 1.6656e-5, 2.9262e-5)  # Forster
    rotor_radius_m: Positive = 0.0231  # Panerati
    thrust_factor: Positive = 2.88e-8  # Panerati: 3.16e-10 N/rpm2
    torque_factor: Positive = 7.24e-10  # Panerati: 7.94e-12 N m/rpm2
    max_rotor_speed: Positive = 2274.0  # rad/s; Panerati: together 2.25 times the weight
    motor_lag_s: Positive = 0.03  # assumed
    drag: tuple[NonNegative, NonNegative, NonNegative] = (0.0056, 0.0056, 0.0062)  # Forster, with the rotor speeds of hovering
    max_speed: Positive = 2.0  # assumed
    max_climb: Positive = 1.0  # the firmware's limit of the vertical velocity
    max_yaw_rate: Positive = 3.5  # assumed
    max_tilt_rad: Positive = 0.349  # 20 degrees, as in the firmware
    position_gain: Positive = 2.0  # the firmware's
    velocity_gain: Positive = 4.3  # the firmware's: 25 degrees of tilt for each m/s
    velocity_integral: NonNegative = 0.5  # assumed; drag is small
