"""The channel without a run: broadcast trials, model curves, coverage."""
