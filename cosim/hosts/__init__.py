"""Hosts of agents: in this process, in child processes, and on other machines."""
