"""The bridge process beside the run, and the messages between both. Nothing of the channel."""
