"""The federate that runs agents in the process of the kernel."""

from vcmvsp.agents.federate import AgentHost
