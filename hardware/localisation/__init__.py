"""Positioning systems of real robots: their messages become `Located`. Filters and fusion are in `cosim.estimation`."""
