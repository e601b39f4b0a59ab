"""The control station: a run in the browser while it goes on, or a recorded one afterwards.

It shows values and gives orders; it steps no federate and writes no file of a run.

Start reading in `messages`.
"""

HOST, PORT = "127.0.0.1", 8080
FOXGLOVE_PORT = 8765
"""Address and port of the page, and port of the stream for Foxglove, unless options name others."""
