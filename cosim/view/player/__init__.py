"""The view of a recorded run: reading a recording by time.

It gives the messages that a run in progress gives, and draws nothing.
"""
