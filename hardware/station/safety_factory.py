"""What a mission says of safety, as a supervisor that looks at states; on the ground and in the air alike."""

from typing import Protocol

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, VehicleState, Velocity, frozen
from vcmvsp.hardware.safety import Cause, Decision, Heard, Limits, Others, Parameters, Polygon, Supervisor, TimeOuts
from vcmvsp.hardware.safety.aerial_supervisor import AerialParameters, AerialSupervisor
from vcmvsp.hardware.station.messages import Mission, Safety

SLOWING = (Cause.LIMITS, Cause.GEOFENCE, Cause.SEPARATION)  # these change a command; all others stop the robot
LATCHED = (Cause.OPERATOR,)  # a person has to see to it; once a run or a clock is well again, the robot goes on
KNOWN_S = 1.0  # others are taken to go on for so long
NOBODY = frozen(np.empty((0, 7)))


class Guard(Protocol):
    """Decides what a robot is sent; see `hardware.safety.Supervisor.step`."""

    def step(self, now_ns: int, command: Velocity | None, state: VehicleState | None, others: Others, heard: Heard) -> Decision:
        """Once a turn."""


def guard(mission: Mission) -> Guard:
    """The one that a mission asks for; a `ValueError` says what is wrong with it."""
    return Air(mission.safety) if mission.flies else Ground(mission.safety)


class Ground:
    """For robots with two driven wheels."""

    def __init__(self, safety: Safety) -> None:
        self._supervisor = Supervisor(_parameters(safety))

    def step(self, now_ns: int, command: Velocity | None, state: VehicleState | None, others: Others, heard: Heard) -> Decision:
        """A robot whose pose is not known is stopped, also where there is neither a fence nor anybody else."""
        pose = None if state is None else (state.position[0], state.position[1], state.yaw)
        return self._supervisor.step(now_ns, command, pose, others, heard)


class Air:
    """For vehicles that take velocities in three axes of the world."""

    def __init__(self, safety: Safety) -> None:
        common = msgspec.structs.asdict(_parameters(safety))
        parameters = AerialParameters(**common, climb_mps=safety.max_climb, floor_m=safety.floor_m, ceiling_m=safety.ceiling_m)
        self._supervisor = AerialSupervisor(parameters)

    def step(self, now_ns: int, command: Velocity | None, state: VehicleState | None, others: Others, heard: Heard) -> Decision:
        """The same in the air."""
        pose = None if state is None else (*state.position, state.yaw)
        return self._supervisor.step(now_ns, command, pose, others, heard)


def _parameters(safety: Safety) -> Parameters:
    """What is the same on the ground and in the air."""
    limits = Limits(
        speed_mps=safety.max_speed,
        yaw_rate_radps=safety.max_yaw_rate,
        accel_mps2=safety.accel,
        stop_mps2=safety.decel,
        yaw_accel_radps2=safety.yaw_accel,
        yaw_stop_radps2=safety.yaw_decel,
    )
    return Parameters(
        limits=limits,
        radius_m=safety.radius_m,
        reaction_s=safety.reaction_s,
        fence=None if safety.fence is None else Polygon(safety.fence),
        fence_margin_m=safety.fence_margin_m,
        separation_m=safety.separation_m,
        time_outs=TimeOuts(
            operator_s=safety.operator_s,
            command_s=safety.command_s,
            positioning_s=safety.positioning_s,
            federation_s=safety.federation_s,
        ),
        latched=LATCHED,
    )


def others_at(rows: Array | None, age_s: float) -> Others:
    """The other vehicles of an order (see `Order.others`), so many seconds later."""
    if rows is None:
        rows = NOBODY
    velocity = rows[:, 3:6]
    return Others(rows[:, 0:3] + velocity * max(0.0, min(age_s, KNOWN_S)), velocity, rows[:, 6])
