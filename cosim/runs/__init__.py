"""One run: start, simulation, result, replay, launch with remote hosts, step response.

Federates are built in `cosim.assembly`, many runs are `cosim.studies`, terminal output is `cosim.terminal`.
"""
