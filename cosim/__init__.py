"""The core of VCMVSP: time, scenarios, agents, recordings, studies, and the command line.

This folder itself holds what authors of agents and federates read: `agent`, `federate`, `clock`, `rng`, `errors`. These import
`types` and `frames` alone; whatever needs more has a package of its own.
"""

if __name__ != "vcmvsp.cosim":
    raise ImportError(f"this is vcmvsp.cosim: import it by that name, not as '{__name__}'")
