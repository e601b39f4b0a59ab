"""``make bench``: cost of the platform beside its building blocks and peers, measured in one run."""
