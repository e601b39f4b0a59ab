"""From a scenario to federates: vehicles, agents, radio, world, bridge, robots.

The only package of the core that imports physics, netsim, agents and hardware; it does not step what it builds.
"""
