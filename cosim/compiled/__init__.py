"""Numerical loops that run interpreted or compiled, with the same bits."""
