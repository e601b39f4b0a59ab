"""The command line `vcmvsp`: one module for the commands of one subject; `cosim.cli.app` lists all.

A command parses its options, calls what Python users call, and prints. Models and computations may not be here, nor imports of
physics, netsim, agents and hardware: commands reach these through `cosim.assembly`. Heavy modules load inside functions.
"""
