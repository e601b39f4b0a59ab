"""Safety between a command and a real robot, the last step before its driver. No driver, link or process belongs here.

::

    limits              speeds and accelerations
    braking             stopping distance, and the speed for a given distance
    obstacle_distance   distance to walls and discs, over a range of headings
    geofence            a polygon that the robot stays inside
    separation          distance to other vehicles, real or simulated
    deadman             time-outs of monitored sources
    control_step        parameters, and one step of a supervisor
    ground_supervisor   supervisor of a robot with two driven wheels
    aerial_supervisor   supervisor of a vehicle that flies, with floor and ceiling
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
