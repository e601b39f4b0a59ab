"""Algorithms that run on vehicles, and the host that builds and calls them. Start reading in `agents.federate`.

An agent sees observations and its radio only: no physics, no channel, no driver, no clock of the machine.
"""

if __name__ != "vcmvsp.agents":
    raise ImportError(f"this is vcmvsp.agents: import it by that name, not as '{__name__}'")
