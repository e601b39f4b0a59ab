"""A mission: several algorithms on one vehicle, the state table that selects the commander, and messages between members.

An algorithm is any agent. Optional members besides ``act``:

``facts(obs)``           facts for the table (`agents.reconnaissance.state_table.MissionFacts`), before its decision
``stand_by(obs, radio)`` in place of ``act`` while it neither commands nor is the task
``begin(obs, place)``    it becomes the task; ``place``: of the target, m, world, or None
``end(obs)``             it is no longer the task
``claim``                the target that it tracks (`agents.reconnaissance.roster.Claim`), or None
``goal``                 its destination, x and y, m, world, or None: for avoidance
``roster``, ``watch``    None in the class: set to the vehicle's objects before ``start``
"""

from collections.abc import Mapping, Sequence
from typing import Any

from vcmvsp.agents.avoidance import Avoidance
from vcmvsp.agents.avoidance.avoid import GetAround
from vcmvsp.agents.factory import build_nested
from vcmvsp.agents.formation.aerial import along, report_keys
from vcmvsp.agents.formation.reports.report import send_report
from vcmvsp.agents.mission.runner import AlgorithmRunner, Guard
from vcmvsp.agents.reconnaissance.roster import Claim, Roster, members_of
from vcmvsp.agents.reconnaissance.state_table import TASKS, MissionFacts, MissionState, step
from vcmvsp.agents.reconnaissance.watch import Watch, Watching
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.config.binding import unknown
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import NonNegative, Positive, Velocity, Waypoint


class SearchMission(Agent):
    """Search, formation and track by a state table (`state_table`), with avoidance and a speed limit near obstacles.

    Notes ``commander``, ``since_s`` and ``why`` at every switch, ``task`` and ``task_why`` when the task changes, besides the
    notes of the algorithms.

    Args:
        algorithms: by task: ``search``, ``formation`` (for wingmen in a shared sector), ``track``; each a table with the
            ``kind`` of an agent and its parameters. Without ``track`` no target is tracked.
        watching: camera and targets, shared by all algorithms. Default: none.
        avoidance: method of avoidance and speed limit near obstacles; default: none.
        members: all members; default: all vehicles of the run.
        sectors: groups that search one sector together; the first of each searches, the others fly in formation. Other members
            have a sector of their own.
        acceleration: m/s2, of the command after a take-over.
        yaw_acceleration: rad/s2, of the command after a take-over.
        alive_s: silence after which a member counts as lost, s.
        claim_s: how long the target of a lost member stays reserved, s.
        report_s: period of a member's reports, s.
        clock_bound_s: largest lead of other clocks, s.
    """

    def __init__(
        self,
        algorithms: dict[str, dict[str, Any]],
        *,
        watching: Watching | None = None,
        avoidance: Avoidance | None = None,
        members: tuple[str, ...] = (),
        sectors: tuple[tuple[str, ...], ...] = (),
        acceleration: Positive = 3.0,
        yaw_acceleration: Positive = 2.0,
        alive_s: Positive = 5.0,
        claim_s: Positive = 30.0,
        report_s: Positive = 1.0,
        clock_bound_s: NonNegative = 0.0,
    ) -> None:
        self._tasks = self._algorithms = _build_algorithms(algorithms)
        self._watch = None if watching is None else Watch(watching)
        self.avoidance, self.members, self.sectors = avoidance, members, sectors
        self._limits = {"acceleration": acceleration, "yaw_acceleration": yaw_acceleration}
        self._hearing = {"alive_s": alive_s, "claim_s": claim_s, "report_s": report_s, "clock_bound_s": clock_bound_s}
        if sectors and any(len(sector) > 1 for sector in sectors) and "formation" not in algorithms:
            raise ScenarioError("shared sectors need an algorithm for formation: add algorithms.formation", key="algorithms")
        self._flies_along = {  # by sector: files of agents are found in the scenario's folder only now
            tuple(sector): build_nested(_of_sector(algorithms["formation"], sector), "algorithms.formation")
            for sector in sectors
            if len(sector) > 1
        }
        self.period = self._tasks["search"].period
        self._around = None if avoidance is None else GetAround(avoidance)
        self._runner = self._make_runner()
        task_sensors, own_sensors = self._runner.sensors, () if self._watch is None else self._watch.sensors
        self.sensors = None if task_sensors is None else tuple(dict.fromkeys((*task_sensors, *own_sensors)))
        self._state, self._seq = MissionState(), 0

    def start(self, info: VehicleInfo) -> None:
        """Find the members, and start the algorithms."""
        name, members = info.name, members_of(info, self.members)
        self._roster = Roster(name, members, sectors=self.sectors, **self._hearing)
        sector = tuple(next((each for each in self.sectors if name in each), (name,)))
        self._leads = name != sector[-1]  # others fly along
        self._tasks = dict(self._algorithms)
        if name == sector[0]:
            self._tasks.pop("formation", None)
        elif "formation" in self._tasks:
            self._tasks["formation"] = self._flies_along[sector]
        if self._watch is not None:
            self._watch.start(info)
        for algorithm in self._tasks.values():
            for attribute, value in (("roster", self._roster), ("watch", self._watch)):
                if hasattr(algorithm, attribute):
                    setattr(algorithm, attribute, value)
        self._runner = self._make_runner()
        self._state, self._seq = MissionState(), 0
        self._runner.start(info)
        self.note(task=self._state.task, task_why=self._state.task_why)

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint | None:
        """Collect the facts, select the commander, and return its command."""
        self._roster.hear(obs)
        self._runner.look(obs)
        before, facts = self._state, self._facts(obs)
        state = self._state = step(before, facts)
        if state.task != before.task:
            self._turn(obs, before.task, state.task, facts)
            self.note(task=state.task, task_why=state.task_why)
        task = self._tasks[state.task]
        if self._around is not None:
            self._around.goal = getattr(task, "goal", None)
        command = self._runner.act(obs, radio, state.name, task=state.task, why=state.why)
        claim: Claim | None = getattr(self._tasks.get("track"), "claim", None)
        self._roster.tell(obs, radio, state.task, claim)
        self.follows = task.follows if state.task == "formation" else None
        if self._leads and state.task == "search":
            self._report(obs, radio, command)
        for notes in self._runner.said.values():
            self.note(**notes)
        self.note(**self._runner.notes)
        for value in self._runner.shown:
            self.show(value)
        return command

    def close(self) -> None:
        """Close all algorithms."""
        self._runner.close()

    def _make_runner(self) -> AlgorithmRunner:
        guard = None if self.avoidance is None else Guard(self.avoidance)
        around = {} if self._around is None else dict.fromkeys(("avoid1", "avoid2"), self._around)
        return AlgorithmRunner({**self._tasks, **around}, guard=guard, **self._limits)

    def _facts(self, obs: Observation) -> MissionFacts:
        facts: dict[str, Any] = {}
        for task, algorithm in self._tasks.items():
            if (tell := getattr(algorithm, "facts", None)) is not None:
                facts_of_task = tell(obs)
                for name in facts_of_task:
                    if name not in MissionFacts._fields:
                        raise ValueError(f"algorithms.{task}: facts() returned {unknown('fact', name, MissionFacts._fields)}")
                facts |= facts_of_task
        if "track" not in self._tasks:
            facts |= {"recognised": False, "probability": 0.0}
        if "formation" not in self._tasks:
            facts["shared"] = False
        guard = self._runner.guard
        if guard is not None:
            near = guard.nearest_m, guard.settings.reach_m, guard.second_m
            facts |= {"nearest_m": near[0], "first_m": near[1], "second_m": near[2], "closing": guard.closing}
        return MissionFacts(now_ns=obs.clock_ns, **facts)

    def _turn(self, obs: Observation, before: str, after: str, facts: MissionFacts) -> None:
        if (end := getattr(self._tasks[before], "end", None)) is not None:
            end(obs)
        if (begin := getattr(self._tasks[after], "begin", None)) is not None:
            begin(obs, facts.place)

    def _report(self, obs: Observation, radio: Radio, command: Velocity | Waypoint | None) -> None:
        """Report the motion of this vehicle to the members in formation with it."""
        velocity, rate = obs.state.velocity, obs.state.angular_velocity[2]
        if isinstance(command, Velocity):
            velocity, rate = command.linear, command.yaw_rate
        send_report(radio, self._seq, obs, along(velocity, obs.state.yaw), rate, **report_keys(obs, velocity))
        self._seq += 1


def _build_algorithms(tables: Mapping[str, Mapping[str, Any]]) -> dict[str, Agent]:
    for task in tables:
        if task not in TASKS:
            raise ScenarioError(unknown("task", task, TASKS), key=f"algorithms.{task}")
    if "search" not in tables:
        raise ScenarioError("an algorithm for search is missing: add algorithms.search", key="algorithms")
    return {task: build_nested(tables[task], f"algorithms.{task}") for task in TASKS if task in tables}


def _of_sector(table: Mapping[str, Any], sector: Sequence[str]) -> dict[str, Any]:
    """The table of a formation algorithm, with the formation of its sector as the default."""
    formation = table.get("formation")
    if not isinstance(formation, Mapping) or "members" in formation:
        return dict(table)
    return {**table, "formation": {**formation, "members": list(sector)}}
