"""From a TOML table to a checked call: kinds, registry, binding, error places, parameter documentation.

No keys: those of a scenario's own tables stand in `cosim.scenario`, those of a component are the parameters of its class.
"""
