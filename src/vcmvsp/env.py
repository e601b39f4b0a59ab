"""Environments for multi-agent learning over the emulated radio (``pip install 'vcmvsp[learn]'``)."""

from vcmvsp.cosim.learning.environments import (
    Formation,
    Gates,
    Layout,
    Observed,
    Search,
    Task,
    VehicleEnv,
    VehiclesEnv,
    Worlds,
    WorldsEnv,
    env,
    parallel_env,
    vector_env,
)
from vcmvsp.cosim.learning.registration import register

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
