"""Channel parameters from measured links."""
