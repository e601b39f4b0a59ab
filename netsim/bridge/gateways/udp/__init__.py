"""Plain UDP."""
