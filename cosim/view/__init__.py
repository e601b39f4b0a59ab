"""The control station: a run in the browser while it goes on, or a recorded one afterwards. Start reading in `shown`."""
