"""The values that travel between federates: frozen, SI units, ENU world, quaternions (w, x, y, z).

Small fixed vectors are tuples; scans, pictures and batches are read-only NumPy arrays. Values alone: whatever acts on them, or
reads and writes them, is elsewhere.
"""

from vcmvsp.cosim.types.agent_reports import Follows, Mosaic, Note, ProbabilityMap, Sighting, Sightings
from vcmvsp.cosim.types.operator_actions import Changed, Halted, Moved, Outage
from vcmvsp.cosim.types.quantities import (
    ORIGIN,
    Array,
    Count,
    Decibels,
    FileName,
    Name,
    NonNegative,
    OnLost,
    Period,
    Positive,
    Probability,
    Rate,
    Seconds,
    Seed,
    Spread,
    Value,
    Vec3,
    frozen,
)
from vcmvsp.cosim.types.radio import Datagrams, FrameReport, Message, Reception, Routed, Traffic
from vcmvsp.cosim.types.readings import Fix, Image, Imu, Later, Looks, Measured, Odometry, Reading, Readings, Scan
from vcmvsp.cosim.types.vehicles import (
    Contact,
    Incident,
    Presence,
    Pushed,
    RealStatus,
    States,
    VehicleState,
    Velocity,
    Waypoint,
)

__all__ = [
    "ORIGIN",
    "AnyValue",
    "Array",
    "Changed",
    "Contact",
    "Count",
    "Datagrams",
    "Decibels",
    "FileName",
    "Fix",
    "Follows",
    "FrameReport",
    "Halted",
    "Image",
    "Imu",
    "Incident",
    "Later",
    "Looks",
    "Measured",
    "Message",
    "Mosaic",
    "Moved",
    "Name",
    "NonNegative",
    "Note",
    "Odometry",
    "OnLost",
    "Outage",
    "Period",
    "Positive",
    "Presence",
    "Probability",
    "ProbabilityMap",
    "Pushed",
    "Rate",
    "Reading",
    "Readings",
    "RealStatus",
    "Reception",
    "Routed",
    "Scan",
    "Seconds",
    "Seed",
    "Sighting",
    "Sightings",
    "Spread",
    "States",
    "Traffic",
    "Value",
    "Vec3",
    "VehicleState",
    "Velocity",
    "Waypoint",
    "frozen",
]

AnyValue = (
    VehicleState
    | States
    | Velocity
    | Waypoint
    | Odometry
    | Fix
    | Imu
    | Scan
    | Image
    | Measured
    | Looks
    | Message
    | Reception
    | Note
    | ProbabilityMap
    | Sightings
    | Mosaic
    | Follows
    | Presence
    | RealStatus
    | Incident
    | FrameReport
    | Datagrams
    | Traffic
    | Routed
    | Contact
    | Pushed
    | Outage
    | Changed
    | Moved
    | Halted
)
