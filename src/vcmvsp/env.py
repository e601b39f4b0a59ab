"""Environments for multi-agent learning over the emulated radio (``pip install 'vcmvsp[learn]'``)."""

from vcmvsp.cosim.learning.environments import Formation, Gates, Search, Task, Worlds, env, parallel_env, vector_env

__all__ = ["Formation", "Gates", "Search", "Task", "Worlds", "env", "parallel_env", "vector_env"]
