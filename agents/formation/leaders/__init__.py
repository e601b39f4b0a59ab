"""Leaders on the ground: where they go, and who drives them. Reports and shapes are in packages beside it."""
