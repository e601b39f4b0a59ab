"""Algorithms: one agent per vehicle, and the host that runs them."""
