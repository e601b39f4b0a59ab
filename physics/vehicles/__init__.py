"""Vehicles as parameters, and the specification of one. How they move is in `physics.dynamics`."""
