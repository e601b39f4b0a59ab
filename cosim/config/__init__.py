"""From a TOML table to a checked call: kinds, registry, binding, error places, parameter documentation."""
