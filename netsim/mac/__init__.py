"""Medium access."""
