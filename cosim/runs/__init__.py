"""One run: start, simulation, result, replay, launch with remote hosts, step response."""
