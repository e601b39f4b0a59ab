"""Layers on top of reception: loss, delay, rate limit, jammers, scripted changes, traces. Nothing of standards or access."""
