"""A quadrotor as a set of parameters; `physics.dynamics.quadrotor_fleet` makes a fleet of them fly.

Its reference point is the centre of mass. Rotors are in plus configuration: in front (+x), left (+y), behind, right; front and
back turn counter-clockwise seen from above, so that their drag turns the body clockwise. Sources:

* Duffy: measurements of an F330 frame with 8 inch propellers on owenduffy.net: 0.86 kg ready to fly; 190 g of thrust from
  16.8 W at the shaft, at 4626 rpm.
* Parts: added up from the masses and places of frame, motors, battery and electronics.
* Assumed: a plausible value without a published source. Tuned: chosen for the step responses in this part's README.
"""

import math
from dataclasses import dataclass

from vcmvsp.cosim.types import NonNegative, Positive
from vcmvsp.physics.world.solids import Hull


@dataclass(frozen=True, kw_only=True)
class Quadrotor:
    """A quadrotor of the 330 class (GAUI 330X, F330), which takes velocities with a yaw rate, and way-points."""

    radius_m: Positive = 0.267  # of the cylinder around it: 0.165 m arm and half a propeller of 0.2032 m
    height_m: Positive = 0.08  # of that cylinder, which the centre of mass is in the middle of
    mass_kg: Positive = 0.80  # all of it; Duffy, with a smaller battery
    arm_m: Positive = 0.165  # from the centre to each rotor: 0.33 m from motor to motor
    inertia: tuple[Positive, Positive, Positive] = (0.0040, 0.0040, 0.0073)  # kg m2, about x, y, z; parts
    rotor_radius_m: Positive = 0.1016  # half a propeller of 8 inches
    thrust_factor: Positive = 7.9e-6  # N s2/rad2: a rotor at w rad/s lifts this times w squared; Duffy
    torque_factor: Positive = 1.47e-7  # N m s2/rad2: ... and its drag turns the body with this times w squared; Duffy
    max_rotor_speed: Positive = 838.0  # rad/s; 5.5 N each, 2.8 times the weight together; assumed
    motor_lag_s: Positive = 0.05  # first-order lag of the rotor speed; assumed
    drag: tuple[NonNegative, NonNegative, NonNegative] = (0.25, 0.25, 0.35)  # N s/m, along x, y, z, against the air; assumed
    ground_effect: bool = False  # more thrust close above the floor, see `physics.dynamics.rotorwash`
    downwash: bool = False  # blown down by those above it, see `physics.dynamics.rotorwash`

    max_speed: Positive = 8.0  # m/s, horizontal, of its autopilot; assumed
    max_climb: Positive = 3.0  # m/s, up and down; assumed
    max_yaw_rate: Positive = 2.0  # rad/s; assumed
    max_tilt_rad: Positive = 0.4363  # from upright, 25 degrees; assumed
    max_thrust: Positive = 0.9  # of what the rotors can, in steady flight: the rest is for turning; assumed
    braking: Positive = 2.0  # m/s2, that it counts on when it comes to a way-point; assumed
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
            raise ValueError(f"max_thrust = {self.max_thrust} is a part of what the rotors can, at most 1")

    @property
    def hull(self) -> Hull:
        """The cylinder around it."""
        return Hull((2.0 * self.radius_m, 2.0 * self.radius_m, self.height_m), kind="cylinder")

    @property
    def max_rotor_thrust(self) -> float:
        """Greatest thrust of one rotor, N."""
        return self.thrust_factor * self.max_rotor_speed**2

    def check_lift(self, gravity: float) -> None:
        """Refuse a quadrotor that cannot hover within its own limits."""
        lift, weight = 4.0 * self.max_thrust * self.max_rotor_thrust, self.mass_kg * gravity / math.cos(self.max_tilt_rad)
        if lift <= weight:
            raise ValueError(
                f"rotors that lift {lift:.3g} N cannot carry {self.mass_kg} kg at max_tilt_rad, which takes {weight:.3g} N"
            )
