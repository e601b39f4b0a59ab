"""Ray casting for range scanners."""
