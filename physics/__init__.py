"""Virtual worlds: vehicles, what surrounds them, and what they can tell of themselves. Start reading in `physics.federate`."""

if __name__ != "vcmvsp.physics":
    raise ImportError(f"this is vcmvsp.physics: import it by that name, not as '{__name__}'")
