"""Real robots in a run: the protocol of their drivers, drivers, and robots in software to try them on."""

if __name__ != "vcmvsp.hardware":
    raise ImportError(f"this is vcmvsp.hardware: import it by that name, not as '{__name__}'")
