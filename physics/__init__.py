"""Virtual worlds: vehicles, what surrounds them, and what they can tell of themselves. Start reading in `physics.federate`."""
