"""A fleet of quadrotors in flight: autopilots, rotors, air and rigid bodies, all at once.

A step is `QuadrotorFleet.wrench`, then `QuadrotorFleet.integrate` for vehicles in free air; for vehicles in contact an engine
writes their states into the fleet's arrays. `QuadrotorFleet.fly` is both, for several steps. The equations are in
`physics.dynamics.quadrotor_laws`: interpreted for little work, compiled for much.
"""

import math
from collections.abc import Callable, Collection, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from vcmvsp.cosim.compiled.machine_code import Core, views
from vcmvsp.physics.dynamics import quadrotor_laws as laws
from vcmvsp.physics.dynamics.quadrotor_laws import FleetModel, FleetState
from vcmvsp.physics.dynamics.wind import Floats, downwash
from vcmvsp.physics.vehicles.models import Quadrotor
from vcmvsp.physics.vehicles.specification import VehicleSpec

VEHICLE_STEP_S = 1e-5  # CPU time of a step of a vehicle, interpreted
COMPILE_FOR_S = 2.0  # of work, interpreted: the compilation takes twice as long, once for each computer

_LEAST_GRAVITY = 1e-9  # m/s2, assumed without gravity: the direction up must exist
_LEAST_LIFT = 0.2  # of the weight, at any rate of descent
_LEAST_TRIM, _MOST_TRIM = -0.3, 0.6  # of gravity: limits of the integral's vertical part, which must not prevent a take-off
_YAW_RESERVE = 0.1  # of the greatest thrust of a rotor
_TINY = 1e-12

# Components of the arrays of `FleetState`.
WIDTHS = {name: kind.__metadata__[0] for name, kind in FleetState.__annotations__.items() if hasattr(kind, "__metadata__")}


Pilot = Callable[[float], None]
"""Called before each step with its duration, s."""


class QuadrotorFleet:
    """n quadrotors, a row each; without commands they hover.

    The state may be read, and written in place, between steps:

    - ``position`` (n, 3) m and ``velocity`` (n, 3) m/s, world, of the centres of mass;
    - ``velocity_before`` (n, 3) m/s, world, before the last step;
    - ``attitude`` (n, 4) w, x, y, z; world_from_body; unit norm;
    - ``rate`` (n, 3) rad/s, body;
    - ``rotor`` (n, 4) rad/s: front, left, back, right.

    They start at ``positions`` (n, 3) m, world, with ``headings`` (n,) rad.
    """

    def __init__(self, models: Sequence[Quadrotor], positions: Any, headings: Any, gravity: float = 9.81) -> None:
        n = len(models)
        for model in models:
            model.check_lift(gravity)
        self._lag_s, self._lag_step_s = column(models, "motor_lag_s"), 0.0
        self._rotor_radius, self._blown = column(models, "rotor_radius_m"), np.array([each.downwash for each in models], bool)
        self._limits = [(model.max_speed, model.max_climb, model.max_yaw_rate) for model in models]
        self._model = model_of(models, gravity)

        # A row for each component, a column for each vehicle.
        arrays = {name: np.zeros((width, n)) for name, width in WIDTHS.items()}
        numbers: dict[str, Any] = {name: np.zeros(n) for name in FleetState.__annotations__ if name not in arrays}
        numbers["clock"] = np.array([0.0, 1.0 / laws.LOOP_HZ])  # outer loops are due at once
        numbers["counts"] = np.zeros(2, np.int64)
        numbers |= {name: tuple(each) for name, each in arrays.items()}
        self._state = s = FleetState(**numbers)
        columns = {name: each.T for name, each in arrays.items()}  # views
        self.position, self.attitude, self.rotor = columns["position"], columns["attitude"], columns["rotor"]
        self.velocity, self.velocity_before, self.rate = columns["velocity"], columns["velocity_before"], columns["rate"]
        self._force, self._torque, self._wind = columns["force"], columns["torque"], columns["wind"]
        self.position[:] = np.array(positions, float).reshape(n, 3)
        s.yaw[:] = s.heading[:] = np.array(headings, float).reshape(n)
        s.attitude[0][:], s.attitude[3][:] = np.cos(0.5 * s.heading), np.sin(0.5 * s.heading)
        s.cos[:], s.sin[:] = np.cos(s.heading), np.sin(s.heading)
        arrays["rotor"][:] = np.sqrt(0.25 * self._model.mass * gravity / self._model.thrust_factor)
        s.speed[:], s.axis[2][:] = column(models, "max_speed"), 1.0
        s.lift_wanted[:] = self._model.mass * self._model.autopilot_gravity

        self._pilot: Pilot | None = None
        self._core = Core((laws,), s, self._model)
        self._run = self._core.interpreted
        self._commands = views(s)

    def expect(self, steps: float, *, now: bool = False) -> None:
        """Hint of the number of steps to come; decides whether to use compiled code: ``now`` always, if available."""
        vehicles = len(self._limits)
        work_s = math.inf if now and vehicles else VEHICLE_STEP_S * steps * vehicles
        self._run = self._core.chosen(work_s, COMPILE_FOR_S)

    def set_velocity(self, row: int, linear: Sequence[float], yaw_rate: float) -> None:
        """Set a velocity, m/s, world, and a yaw rate, rad/s, both within the vehicle's limits."""
        x, y, z = linear
        most, climb, turn = self._limits[row]
        if x * x + y * y > 0.99 * most * most:
            scale = min(1.0, most / max(math.hypot(x, y), _TINY))
            x, y = x * scale, y * scale
        c = self._commands
        target = c.velocity_wanted
        target[0][row] = x
        target[1][row] = y
        target[2][row] = z if -climb <= z <= climb else math.copysign(climb, z)
        c.yaw_rate_wanted[row] = yaw_rate if -turn <= yaw_rate <= turn else math.copysign(turn, yaw_rate)
        c.to_place[row] = 0.0

    def set_waypoint(self, row: int, position: Sequence[float], yaw: float | None = None, speed: float | None = None) -> None:
        """Set a way-point, m, with ``yaw``, rad (None: the present one), and ``speed``, m/s, at most (None: the vehicle's)."""
        c, most = self._commands, self._limits[row][0]
        for component, value in zip(c.place, position, strict=True):
            component[row] = value
        c.yaw[row] = c.heading[row] if yaw is None else yaw
        c.speed[row] = most if speed is None else min(speed, most)
        c.to_place[row] = 1.0

    def fly_by(self, pilot: Pilot) -> None:
        """Call a pilot before each step, which may set rotor speeds by `drive`."""
        self._pilot = pilot

    def drive(self, row: int, speeds: Sequence[float]) -> None:
        """Set the rotor speeds of a vehicle, rad/s, in the order of ``rotor``; they are reached with the motors' lag."""
        for component, speed in zip(self._commands.rotor_wanted, speeds, strict=True):
            component[row] = speed
        self._commands.driven[row] = 1.0

    def release(self, row: int) -> None:
        """Give a vehicle back to its own autopilot, which holds it where it is."""
        c = self._commands
        for trim, reference, velocity in zip(c.trim, c.reference, self.velocity[row].tolist(), strict=True):
            trim[row], reference[row] = 0.0, velocity  # what was integrated meanwhile belongs to another flight
        self.set_waypoint(row, self.position[row].tolist())
        c.driven[row] = 0.0

    def wrench(self, dt: float, wind: Any) -> tuple[Floats, Floats]:
        """Advance autopilots and rotors of all vehicles by ``dt`` s, once a step; wind (n, 3) m/s, world.

        Returns:
            Force on the centre of mass (n, 3) N without gravity, and torque (n, 3) N m, both in the world frame; arrays that
            the next step overwrites.
        """
        self._prepare(dt, wind)
        if self._pilot is not None:
            self._pilot(dt)
        self._do(laws.PUSH)
        return self._force, self._torque

    def integrate(self, force: Any, torque: Any, dt: float) -> None:
        """Move all as free bodies by ``dt`` s under gravity, a force (n, 3) N and a torque (n, 3) N m, both world."""
        self._force[:], self._torque[:] = force, torque
        self._state.clock[laws.STEP] = dt
        self._do(laws.MOVE)

    def fly(self, steps: int, dt: float, wind: Any) -> None:
        """`wrench` and `integrate` for some steps in constant wind (n, 3) m/s, world."""
        self._prepare(dt, wind)
        if self._pilot is None:
            self._do(steps)
            return
        for _ in range(steps):
            self._pilot(dt)
            self._do(1)

    def fly_in(self, winds: Sequence[Any], dt: float) -> None:
        """`fly` a step in each of these winds, (n, 3) m/s, world; equal neighbours are the same object."""
        for _, group in groupby(winds, key=id):
            same = list(group)
            self.fly(len(same), dt, same[0])

    def _prepare(self, dt: float, wind: Any) -> None:
        self._wind[:] = wind
        self._state.clock[laws.STEP] = dt
        if dt != self._lag_step_s:
            self._model.follow[:], self._lag_step_s = -np.expm1(-dt / self._lag_s), dt

    def _do(self, steps: int) -> None:
        s, m = self._state, self._model
        while missing := self._run(s, m, steps):
            steps -= int(s.counts[laws.FLOWN])
            if missing == laws.HEADINGS:
                np.arctan2(s.facing[1], s.facing[0], out=s.heading_now)
            else:
                s.down[:] = np.where(self._blown, downwash(self.position.T, s.lift, self._rotor_radius), 0.0)
            s.counts[laws.STAGE] = missing


def fleet_of(specs: Collection[VehicleSpec], gravity: float) -> QuadrotorFleet:
    """A fleet of quadrotors at their starts."""
    models: list[Any] = [spec.model for spec in specs]
    positions = [spec.start for spec in specs]
    return QuadrotorFleet(models, positions, [spec.heading for spec in specs], gravity)


def model_of(models: Sequence[Quadrotor], gravity: float) -> FleetModel:
    """Constants of vehicles in a gravity, m/s2."""
    n, pilot_gravity = len(models), max(gravity, _LEAST_GRAVITY)
    x, y, z = inertia = columns([model.inertia for model in models], 3)
    arm, factor = column(models, "arm_m"), column(models, "thrust_factor")
    yaw_arm, mass, rate_gain = column(models, "torque_factor") / factor, column(models, "mass_kg"), column(models, "rate_gain")
    tan_tilt = np.tan(column(models, "max_tilt_rad"))
    sideways = pilot_gravity * tan_tilt
    most = column(models, "max_rotor_thrust")
    most_up = column(models, "max_thrust") * 4.0 * most / mass
    gain_squared, braking, yaw_reserve = column(models, "position_gain") ** 2, column(models, "braking"), _YAW_RESERVE * most
    resistance, ground_effect = columns([model.drag for model in models], 3), column(models, "ground_effect")
    return FleetModel(
        gravity=gravity,
        autopilot_gravity=pilot_gravity,
        washed=int(column(models, "downwash").any()),
        mass=mass,
        flexibility=tuple(1.0 / inertia),
        gyration=(z - y, x - z, y - x),
        thrust_factor=factor,
        follow=np.zeros(n),
        arm=arm,
        yaw_arm=yaw_arm,
        crossed=np.array([float(model.frame == "x") for model in models]),
        resistance=tuple(-resistance),
        ground_radius=np.where(ground_effect > 0.0, column(models, "rotor_radius_m"), 0.0),
        max_climb=column(models, "max_climb"),
        max_yaw_rate=column(models, "max_yaw_rate"),
        tan_tilt=tan_tilt,
        sideways=sideways,
        most_up=most_up,
        most_up_squared=most_up**2,
        least_up=np.full(n, _LEAST_LIFT * pilot_gravity),
        most_trim=(sideways, sideways.copy(), np.full(n, _MOST_TRIM * pilot_gravity)),
        least_trim=(-sideways, -sideways, np.full(n, _LEAST_TRIM * pilot_gravity)),
        gain_squared=gain_squared,
        knee=braking / gain_squared,
        braking=braking,
        velocity_gain=column(models, "velocity_gain"),
        integral=column(models, "velocity_integral"),
        attitude_gain=column(models, "attitude_gain"),
        yaw_gain=column(models, "yaw_gain"),
        stiffness=tuple(inertia * np.array([rate_gain, rate_gain, column(models, "yaw_rate_gain")])),
        most=most,
        most_pair=0.5 * most - yaw_reserve,
        yaw_reserve=yaw_reserve,
        rotor_share=(0.5 / arm, 0.5 / arm, 0.25 / yaw_arm),
        per_newton=1.0 / factor,
    )


def column(models: Sequence[object], name: str) -> Floats:
    """An attribute of all models, (n,)."""
    return np.array([getattr(model, name) for model in models], float)


def columns(rows: Any, size: int) -> Floats:
    """A (size, n) copy of (n, size) numbers; n may be 0."""
    return np.array(rows, float).reshape(-1, size).T.copy()
