"""Vehicle models, and the positioning system that a vehicle can carry."""

from vcmvsp.physics.sensors.positioning import Positioning
from vcmvsp.physics.vehicles.specification import Vehicle, flies
