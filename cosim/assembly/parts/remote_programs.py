"""Programs that take part in a run on another machine: a host of agents, and the program on a robot's own computer."""

from vcmvsp.agents.host_process import host as host_agents
from vcmvsp.hardware.remote_robot.robot_side.program import robot as serve_robot

__all__ = ["host_agents", "serve_robot"]
