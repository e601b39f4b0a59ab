"""Real robots in a run: drivers, their stations, safety, localisation, and emulated devices to rehearse with.

No agent and no simulated physics belongs here; a run reaches all of it through `hardware.federate`.
"""

if __name__ != "vcmvsp.hardware":
    raise ImportError(f"this is vcmvsp.hardware: import it by that name, not as '{__name__}'")
