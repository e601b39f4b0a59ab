"""Helpers without knowledge of simulation: text, files, MessagePack, polling, colours.

Of the platform they import `cosim.errors` and `cosim.types` at most.
"""
