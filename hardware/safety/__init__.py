"""Safety between a command and a real robot, after everything else. No driver, link or process belongs here.

::

    limits              speeds and accelerations
    braking             stopping distance, and the speed at which it fits
    obstacle_distance   distance to walls and discs, over all directions in which a robot may come to move
    geofence            a polygon that the robot stays inside
    separation          distance to other vehicles, real or simulated
    deadman             sources that must have been heard lately, else the robot stops
    control_step        parameters of supervisors, start and end of their steps
    ground_supervisor   all of them, once a control period, for a robot with two driven wheels
    aerial_supervisor   the same for a vehicle that flies, with floor and ceiling
"""

from vcmvsp.hardware.safety.aerial_supervisor import AerialParameters, AerialSupervisor
from vcmvsp.hardware.safety.control_step import Decision, Parameters
from vcmvsp.hardware.safety.deadman import Cause, Deadman, LastReceived, TimeOuts
from vcmvsp.hardware.safety.geofence import Polygon
from vcmvsp.hardware.safety.ground_supervisor import GroundSupervisor
from vcmvsp.hardware.safety.limits import Limits, clamp
from vcmvsp.hardware.safety.separation import Others

__all__ = [
    "AerialParameters",
    "AerialSupervisor",
    "Cause",
    "Deadman",
    "Decision",
    "GroundSupervisor",
    "LastReceived",
    "Limits",
    "Others",
    "Parameters",
    "Polygon",
    "TimeOuts",
    "clamp",
]
