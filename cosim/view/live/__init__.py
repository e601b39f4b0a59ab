"""The view of a run in progress: feed, server process, orders.

The run never waits for it; drawing belongs to `cosim.view.page`.
"""
