"""Environments for multi-agent learning over the emulated radio (``pip install 'vcmvsp[learn]'``)."""

from vcmvsp.cosim.learning.environments import env, parallel_env, vector_env
from vcmvsp.cosim.learning.parallel_env import VehiclesEnv
from vcmvsp.cosim.learning.registration import register
from vcmvsp.cosim.learning.single_env import VehicleEnv
from vcmvsp.cosim.learning.task import Layout, Observed, Task, Worlds
from vcmvsp.cosim.learning.tasks import Formation, Gates, Search
from vcmvsp.cosim.learning.vector_env import WorldsEnv

register()

__all__ = [
    "Formation",
    "Gates",
    "Layout",
    "Observed",
    "Search",
    "Task",
    "VehicleEnv",
    "VehiclesEnv",
    "Worlds",
    "WorldsEnv",
    "env",
    "parallel_env",
    "vector_env",
]
