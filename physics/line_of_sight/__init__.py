"""Solids between two points. Beams that look for the nearest solid are in `physics.raycast`."""
