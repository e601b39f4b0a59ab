"""Avoidance around any agent, which need not know about obstacles: `GetAround` for commands, `Avoid` for a whole agent."""

import math
from typing import Any

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.method import Point
from vcmvsp.agents.avoidance.steering import AvoidanceSteering, around
from vcmvsp.agents.avoidance.waypoint import velocity_to
from vcmvsp.agents.factory import build_nested
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.types import Velocity, Waypoint

SAME = 1e-9  # m/s: a velocity turned into the body frame and back


class GetAround(Agent):
    """Does what a task wants, but around what stands in the way.

    Velocities go through the avoidance, in the body frame on wheels, in the world frame in the air (where x and y are looked
    after, not the height). A way-point is left to the autopilot as long as nothing is near; else it is flown to by velocities.

    Noted: ``mode`` and ``level``, when they change.

    Attributes:
        goal: where the task is about to get, x and y, m, world; None: where its commands lead.
    """

    def __init__(self, avoidance: Avoidance, goal: Point | None = None) -> None:
        self.goal = goal
        self._steering = AvoidanceSteering(avoidance)
        self.sensors = self._steering.sensors
        self._flies = False

    def start(self, info: VehicleInfo) -> None:
        """Find the scanner."""
        self._steering.start(info)
        self._flies = info.body is not None and info.body.flies

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """With no task: get out of the way of what comes near."""
        return self.around(obs, radio, Velocity())

    def around(self, obs: Observation, radio: Radio, requested: Velocity | Waypoint | None) -> Velocity | Waypoint | None:
        """What to do in place of what is wanted."""
        command = self._around(obs, requested)
        self.note(**self._steering.notes)
        return command

    def _around(self, obs: Observation, command: Velocity | Waypoint | None) -> Velocity | Waypoint | None:
        if isinstance(command, Waypoint):
            if not self._flies:
                raise ValueError("avoid: the task gave a Waypoint, and a vehicle on wheels takes velocities alone")
            return self._flown(obs, velocity_to(obs, command, self._steering.settings.max_speed), command)
        if not isinstance(command, Velocity):
            return command  # none yet; or something that the host refuses
        if self._flies:
            return self._flown(obs, command, None)
        decision = self._steering.drive(obs, (command.linear[0], command.yaw_rate), self.goal)
        return Velocity(linear=(*decision.velocity, 0.0), yaw_rate=decision.yaw_rate)

    def _flown(self, obs: Observation, command: Velocity, waypoint: Waypoint | None) -> Velocity | Waypoint:
        """The same in the air, for a velocity that may stand for a way-point."""
        goal = self.goal if waypoint is None or self.goal is not None else waypoint.position[:2]
        decision = around(self._steering, obs, command.linear, command.yaw_rate, goal)
        as_wanted = (
            decision.mode == "task"
            and math.dist(decision.velocity, command.linear) < SAME
            and decision.yaw_rate == command.yaw_rate
        )
        if waypoint is not None and self._steering.level == 0 and as_wanted:
            return waypoint
        return Velocity(linear=decision.velocity, yaw_rate=decision.yaw_rate)


class Avoid(Agent):
    """Does what another agent says, but around what stands in the way (`GetAround`).

    Where the task leaves its last command in force, that one is looked at again.

    Noted besides what the task notes: ``mode`` and ``level``, when they change.

    Args:
        task: the agent that says where to go: its ``kind`` and its parameters.
        avoidance: how this vehicle gets around what stands in the way.
        goal: where the task is about to get, x and y, m, world; default: where its commands lead.
    """

    def __init__(self, task: dict[str, Any], avoidance: Avoidance, *, goal: Point | None = None) -> None:
        self.task, self._around = build_nested(task, "task"), GetAround(avoidance, goal)
        self.period = self.task.period
        task_sensors, own_sensors = self.task.sensors, self._around.sensors or ()
        self.sensors = None if task_sensors is None else tuple(dict.fromkeys((*task_sensors, *own_sensors)))
        self._last: Velocity | Waypoint | None = None

    def start(self, info: VehicleInfo) -> None:
        """Both begin."""
        self._around.start(info)
        self._last = None
        self.task.start(info)
        self.follows = self.task.follows

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """What the task says, as far as nothing is in the way."""
        self._last = self.task.act(obs, radio) or self._last
        self.follows = self.task.follows
        command = self._around.around(obs, radio, self._last)
        self.note(**{**self.task.drain_notes(), **self._around.drain_notes()})
        for value in self.task.drain_shown().values():
            self.show(value)
        return command

    def close(self) -> None:
        """Both end."""
        self.task.close()
