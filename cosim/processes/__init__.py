"""Processes of this machine: child processes, a fork server for many of them, local links, a pool of workers.

Bytes alone: their meaning belongs to the caller, other machines to `cosim.transport`.
"""
