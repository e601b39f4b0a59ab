"""Vehicle models, and the positioning system that a vehicle can carry."""

from vcmvsp.physics.sensors.positioning_system import Positioning
from vcmvsp.physics.vehicles.models import Vehicle, flies

__all__ = ["Positioning", "Vehicle", "flies"]
