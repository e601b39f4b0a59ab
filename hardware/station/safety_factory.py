"""Safety supervisor of a station, from the limits of its mission."""

from typing import Any

import msgspec
import numpy as np

from vcmvsp.cosim.types import Array, frozen
from vcmvsp.hardware.safety import Cause, GroundSupervisor, Limits, Others, Parameters, Polygon, TimeOuts
from vcmvsp.hardware.safety.aerial_supervisor import AerialParameters, AerialSupervisor
from vcmvsp.hardware.safety.control_step import Supervisor
from vcmvsp.hardware.station.messages import Safety, StationMission

SLOWING = (Cause.LIMITS, Cause.GEOFENCE, Cause.SEPARATION)  # these change a command; all others stop the robot
LATCHED = (Cause.OPERATOR,)  # needs a person; other causes end by themselves
KNOWN_S = 1.0  # extrapolation time of other vehicles
NO_VEHICLES = frozen(np.empty((0, 7)))


def guard(mission: StationMission) -> Supervisor:
    """Safety supervisor of a mission; `ValueError`: its safety parameters are invalid."""
    safety, common = mission.safety, _parameters(mission.safety)
    if not mission.flies:
        return GroundSupervisor(common)
    heights: dict[str, Any] = {"climb_mps": safety.max_climb, "floor_m": safety.floor_m, "ceiling_m": safety.ceiling_m}
    return AerialSupervisor(AerialParameters(**msgspec.structs.asdict(common), **heights))


def _parameters(safety: Safety) -> Parameters:
    """Parameters that ground and air have in common."""
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
    """Other vehicles of an order (see `StationOrder.others`), extrapolated by ``age_s``."""
    if rows is None:
        rows = NO_VEHICLES
    velocity = rows[:, 3:6]
    return Others(rows[:, 0:3] + velocity * max(0.0, min(age_s, KNOWN_S)), velocity, rows[:, 6])
