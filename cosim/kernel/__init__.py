"""Logical time: the kernel and the event bus.

Federates are known by their contract alone (`cosim.federate`): no physics, radio, agent, scenario or file.
"""
