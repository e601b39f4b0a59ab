"""Processes of this machine: child processes, local links, a pool of workers.

Bytes alone: their meaning belongs to the caller, other machines to `cosim.transport`.
"""
