"""The control station: a run in the browser while it goes on, or a recorded one afterwards. Start reading in `shown`."""

HOST, PORT = "127.0.0.1", 8080
"""Where the page is served, unless somebody says otherwise."""
