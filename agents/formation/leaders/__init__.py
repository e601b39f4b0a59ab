"""Leaders on the ground: their paths and drivers. Reports and shapes are in packages beside it."""
