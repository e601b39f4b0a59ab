"""Several algorithms on one vehicle, of which one commands at a time, and the limit of the speed near obstacles for all.

All of them run all the time: at every tick each computes a command, and the commander's counts. A suspended algorithm keeps its
state (its next way-point, its estimate of a target), receives all messages and may send: maps are exchanged, and neighbours see
that the vehicle is alive. An algorithm that would advance without its vehicle (a path by the clock; a report of its intended
motion) has a method ``stand_by``, which replaces ``act`` while it is neither the commander nor its task.
"""

import math
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

from vcmvsp.agents.avoidance.method import Settings, body_of
from vcmvsp.agents.avoidance.steering import ObstacleLevels, second_m, velocity_to
from vcmvsp.agents.avoidance.view import ScanReader, View
from vcmvsp.cosim.agent import Agent, Observation, Radio, Shown, VehicleInfo
from vcmvsp.cosim.frames import rotate2
from vcmvsp.cosim.types import Vec3, Velocity, Waypoint

Command = Velocity | Waypoint

STANDING = Velocity()


class Guard:
    """Limits the approach speed to obstacles in proportion to the remaining distance; a blind vehicle stands.

    It is independent of states and take-overs and applied last: its result is the vehicle's command.
    """

    def __init__(self, settings: Settings) -> None:
        self.settings, self.sensors = settings, (settings.scanner,)
        self._looking = ScanReader(settings.scanner, settings.stale_s)
        self.nearest_m, self.second_m, self.closing = math.inf, 0.0, False

    def start(self, info: VehicleInfo) -> None:
        """Take the scanner and the body of the vehicle; `ValueError`: one of them is missing."""
        self._looking.start(info, "avoidance.scanner")
        body = body_of(info)
        self._levels = ObstacleLevels(self.settings, body, info.latency_s)
        self._view: View | None = None
        self._flies, self._latency_s = body.flies, info.latency_s

    def look(self, obs: Observation) -> None:
        """Update obstacles at a tick: once, and before `limited`."""
        self._view = view = self._looking.look(obs)
        x, y, _ = obs.state.velocity
        self._speed = math.hypot(x, y)
        self.second_m = second_m(self._speed, self._levels.keep_m, self.settings.braking, self._latency_s)
        if view is None:
            self.nearest_m, self.closing = 0.0, True
            return
        self.nearest_m = view.nearest_m
        towards = rotate2(x, y, -obs.state.yaw)
        direction = view.units[int(view.ranges.argmin())]
        self.closing = math.isfinite(self.nearest_m) and float(direction @ towards) > 0.0

    def limited(self, obs: Observation, command: Command) -> Command:
        """The command, slowed near obstacles. The climb does not change, unless the vehicle has no valid scan.

        Near an obstacle a way-point becomes a velocity towards it, because the speed of an autopilot is unknown.
        """
        if self._view is None or not self._view.ranges.any():
            return STANDING
        straight = velocity_to(obs, command, self.settings.max_speed) if isinstance(command, Waypoint) else command
        x, y, z = straight.linear
        yaw = obs.state.yaw if self._flies else 0.0
        requested = rotate2(x, y, -yaw)
        level = self._levels.update(obs.time_ns, self._view.nearest_m, max(self._speed, math.hypot(x, y)))
        allowed = self._levels.limited(self._view, requested)
        if allowed == requested:
            return command if level < 2 else straight
        return Velocity(linear=(*rotate2(*allowed, yaw), z), yaw_rate=straight.yaw_rate)


@runtime_checkable
class Standby(Protocol):
    """An agent with a substitute for `act` while its command is not needed."""

    def stand_by(self, obs: Observation, radio: Radio) -> None:
        """Receive and send messages without a command."""


@runtime_checkable
class Avoidance(Protocol):
    """An agent that modifies the task's command. It is called in place of `act`, after all tasks."""

    def around(self, obs: Observation, radio: Radio, command: Command | None) -> Command | None:
        """The command in place of the task's; None: no command yet."""


class AlgorithmRunner:
    """Runs algorithms, by commander name, applies the command of one of them, and switches smoothly.

    After a take-over the command moves from the last one towards the new commander's, no faster than the vehicle can follow
    (``acceleration``, m/s2, ``yaw_acceleration``, rad/s2). The guard comes after that, and may brake harder. A commander that
    has never had a command stands still. Notes ``commander``, ``since_s`` and ``why`` when they change.
    """

    def __init__(
        self, algorithms: Mapping[str, Agent], *, acceleration: float, yaw_acceleration: float, guard: Guard | None = None
    ) -> None:
        self.algorithms, self.guard = dict(algorithms), guard
        self.acceleration, self.yaw_acceleration = acceleration, yaw_acceleration
        each = {id(agent): agent for agent in self.algorithms.values()}.values()
        self._agents = sorted(each, key=lambda agent: isinstance(agent, Avoidance))  # tasks first, in their order
        self.notes: dict[str, float | str | bool] = {}
        self.said: dict[str, dict[str, float | str | bool]] = {}  # notes of the agents at the last tick, by their first names
        self.shown: list[Shown] = []  # what they showed

    @property
    def sensors(self) -> tuple[str, ...] | None:
        """Sensors of all algorithms; None: all sensors."""
        names = dict.fromkeys(() if self.guard is None else self.guard.sensors)
        for agent in self._agents:
            if agent.sensors is None:
                return None
            names.update(dict.fromkeys(agent.sensors))
        return tuple(names)

    def start(self, info: VehicleInfo) -> None:
        """Start all algorithms."""
        self._period_s, self._flies = info.period_s, info.body is not None and info.body.flies
        self._wants: dict[int, Command | None] = {}  # by agent: its last command, which may stay in force
        self._commander: str | None = None
        self._obeyed: Agent | None = None
        self._command: Command | None = None  # of the last tick
        self._runs_up = False  # from a take-over until the command equals the commander's
        if self.guard is not None:
            self.guard.start(info)
        for agent in self._agents:
            agent.start(info)

    def close(self) -> None:
        """Close all algorithms."""
        for agent in self._agents:
            agent.close()

    def look(self, obs: Observation) -> None:
        """Update `guard` with the newest scan. Call at every tick, before `act`."""
        if self.guard is not None:
            self.guard.look(obs)

    def act(self, obs: Observation, radio: Radio, commander: str, *, task: str | None = None, why: str = "") -> Command | None:
        """Run all algorithms for a tick; returns the command of ``commander``, which is noted with ``why`` when it changes.

        An `Avoidance` leads the command of ``task`` around obstacles; default: that of the commander.
        """
        obeyed = self.algorithms[commander]
        self._ask(obs, radio, obeyed, self.algorithms[task or commander])
        is_new, self._commander = commander != self._commander, commander
        self.notes = {"commander": commander, "since_s": obs.time_s, "why": why} if is_new else {}
        self._runs_up = self._runs_up or (self._obeyed is not None and obeyed is not self._obeyed)
        self._obeyed = obeyed
        requested = self._wants.get(id(obeyed))
        if requested is None:
            if self._command is None:
                return None
            requested = STANDING
        self._command = self._run_up(obs, requested)
        if self.guard is not None:
            self._command = self.guard.limited(obs, self._command)
        return self._command

    def _ask(self, obs: Observation, radio: Radio, obeyed: Agent, task: Agent) -> None:
        """Run each algorithm; one without a new command keeps its last."""
        self.said, self.shown = {}, []
        names = {id(agent): name for name, agent in reversed(self.algorithms.items())}
        for agent in self._agents:
            answer: Command | None
            if agent is not obeyed and agent is not task and isinstance(agent, Standby):
                agent.stand_by(obs, radio)
                answer = None
            elif isinstance(agent, Avoidance):
                answer = agent.around(obs, radio, None if agent is task else self._wants.get(id(task)))
            else:
                answer = agent.act(obs, radio)
            if answer is not None:
                self._wants[id(agent)] = answer
            if notes := agent.drain_notes():
                self.said[names[id(agent)]] = notes
            self.shown += agent.drain_shown().values()

    def _run_up(self, obs: Observation, command: Command) -> Command:
        """The next command on the way from the last one to the requested one."""
        if not self._runs_up or isinstance(command, Waypoint):  # an autopilot applies its own limits
            self._runs_up = False
            return command
        last = self._command if isinstance(self._command, Velocity) else self._moving(obs)
        linear = _towards(last.linear, command.linear, self.acceleration * self._period_s)
        turn, most = command.yaw_rate - last.yaw_rate, self.yaw_acceleration * self._period_s
        yaw_rate = command.yaw_rate if abs(turn) <= most else last.yaw_rate + math.copysign(most, turn)
        self._runs_up = linear != command.linear or yaw_rate != command.yaw_rate
        return Velocity(linear=linear, yaw_rate=yaw_rate) if self._runs_up else command

    def _moving(self, obs: Observation) -> Velocity:
        x, y, z = obs.state.velocity
        if not self._flies:
            x, y = rotate2(x, y, -obs.state.yaw)
        return Velocity(linear=(x, y, z), yaw_rate=obs.state.angular_velocity[2])


def _towards(start: Vec3, end: Vec3, most: float) -> Vec3:
    distance = math.dist(start, end)
    if distance <= most:
        return end
    (a, b, c), (x, y, z), share = start, end, most / distance
    return a + share * (x - a), b + share * (y - b), c + share * (z - c)
