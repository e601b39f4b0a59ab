"""Programs as they are on the emulated network: what they send crosses the channel and leaves at its time (README.md)."""
