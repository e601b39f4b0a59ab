"""From a scenario to federates: vehicles, agents, radio, world, bridge, robots."""
