"""The view of a run in progress: feed, server process, orders."""
