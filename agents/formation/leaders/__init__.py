"""Leaders on the ground."""
