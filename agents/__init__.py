"""Algorithms: one agent per vehicle, and the host that runs them."""

if __name__ != "vcmvsp.agents":
    raise ImportError(f"this is vcmvsp.agents: import it by that name, not as '{__name__}'")
