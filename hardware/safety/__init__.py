"""What stands between a command and a real robot, after everything else: limits, fence, distance, deadman; see `Supervisor`.

::

    limits       how fast, and how fast to become so
    braking      how far a robot moves until it stands, and how fast it may be so that this fits
    sector       how far it is to walls and discs, over all directions in which a robot may come to move
    geofence     a polygon that it stays inside
    separation   other vehicles, real or simulated, that it keeps away from
    deadman      who must have been heard lately, else it stops
    rounds       what a supervisor's step begins and ends with
    supervisor   all of them, once a control period, for a robot with two driven wheels
    aerial       the same for a vehicle that flies, with floor and ceiling
"""

from vcmvsp.hardware.safety.aerial_supervisor import AerialParameters, AerialSupervisor
from vcmvsp.hardware.safety.control_step import Decision
from vcmvsp.hardware.safety.deadman import Cause, Deadman, Heard, TimeOuts
from vcmvsp.hardware.safety.geofence import Polygon
from vcmvsp.hardware.safety.ground_supervisor import Parameters, Supervisor
from vcmvsp.hardware.safety.limits import Limits, clamp
from vcmvsp.hardware.safety.separation import Others

__all__ = [
    "AerialParameters",
    "AerialSupervisor",
    "Cause",
    "Deadman",
    "Decision",
    "Heard",
    "Limits",
    "Others",
    "Parameters",
    "Polygon",
    "Supervisor",
    "TimeOuts",
    "clamp",
]
