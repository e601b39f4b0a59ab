"""Programs that join a run on another machine: the agent host, and the program on a robot's computer."""

from vcmvsp.agents.host_process import host as host_agents
from vcmvsp.hardware.remote_robot.robot_side.program import robot as serve_robot
