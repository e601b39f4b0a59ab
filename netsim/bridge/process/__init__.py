"""The bridge process beside the run."""
