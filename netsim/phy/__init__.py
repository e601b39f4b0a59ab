"""Radio standards: air times, noise, error rates."""
