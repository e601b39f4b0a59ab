"""Hosts of agents: in this process, in child processes, and on other machines.

Nothing about what agents compute, which is `agents`, nor about sessions and certificates, which are `cosim.transport` and
`cosim.security`.
"""
