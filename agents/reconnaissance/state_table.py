"""State table of a vehicle on a search: selects the commander, as a pure function of the state and of the facts of a tick.

=========  ==================================  ============================================  ===============================
state      entered                             left                                          commander
=========  ==================================  ============================================  ===============================
search     at the start; a target is lost      a target is confirmed                         the search
formation  the same, where two or more share   the same                                      the law of the formation
           a sector
track      3 detections of 5 frames, or the    3 s without a detection, and then 10 s on a   the tracker; lost: a spiral
           map is sure (P > 0.99)              spiral; another one tracks it                 around where it was seen last
avoid1     something nearer than d1, and       nothing nearer than d1 + 0.2 m for 0.5 s:     avoidance, in the direction
           closing on it                       back to the task                              that the task wants
avoid2     something nearer than d2            nothing nearer than d2 + 0.15 m for 0.5 s:    the same
                                               to avoid1
=========  ==================================  ============================================  ===============================

avoid2 goes before avoid1, avoid1 before track, track before search. Search, formation and track are the tasks; a task that
avoidance interrupts stays the task, and commands again afterwards. A task may still change meanwhile: pictures are processed
and maps are exchanged in every state, so a target that is confirmed during avoidance is tracked after it. The 10 s of a spiral
count with any commander, as avoidance only modifies the tracker's command: otherwise a vehicle that cannot reach the reported
place of a target (on a roof, in a narrow street) would stay in avoidance forever.

There is never a switch within 0.5 s of another, so avoid2 may begin half a second late. Safety does not depend on it: the speed
limit near obstacles applies to the command of any commander (`agents.mission.runner`, `agents.avoidance.steering`), from the
first tick at which something is nearer than d2. Only the way around is late. At the end of the half second the present facts
decide, and avoid2 has priority over all other states.
"""

import math
from typing import Literal, NamedTuple, get_args

from vcmvsp.cosim.clock import seconds_to_ns

Task = Literal["search", "formation", "track"]
Name = Literal["search", "formation", "track", "avoid1", "avoid2"]
TASKS: tuple[Task, ...] = get_args(Task)

DWELL_NS = seconds_to_ns(0.5)  # from switch to switch, at least
CLEAR_NS = seconds_to_ns(0.5)  # time without near obstacles before a level ends
CLEAR_M = {"avoid1": 0.2, "avoid2": 0.15}  # hysteresis of the distances
SURE = 0.99  # probability of a target in a cell of the map
LOST_NS = seconds_to_ns(3.0)  # without a detection: lost
SPIRAL_NS = seconds_to_ns(10.0)  # duration of the search for it after that


class MissionFacts(NamedTuple):
    """Facts of a tick for the state table."""

    now_ns: int
    nearest_m: float = math.inf  # distance of the nearest obstacle, m; NaN (unknown) counts as near
    closing: bool = False  # whether it comes nearer
    first_m: float = 1.2  # d1: distance at which avoidance first considers obstacles
    second_m: float = 0.9  # d2: distance at which the vehicle must be slow; depends on its speed
    shared: bool = False  # whether others search the same sector
    recognised: bool = False  # a target, by detections in several frames
    probability: float = 0.0  # of the surest cell with an unclaimed target that was not given up since
    seen_ns: int | None = None  # last detection of the tracked target
    taken: bool = False  # another vehicle tracks that target, the confirmed or the tracked one
    place: tuple[float, float] | None = None  # m, world: of the recognised or probable target


class MissionState(NamedTuple):
    """State of the table: which algorithm commands the vehicle, the task, and the timers."""

    name: Name = "search"
    task: Task = "search"  # the commander, or the algorithm that commands again after avoidance
    since_ns: int = 0  # of the last switch
    why: str = "start"
    task_why: str = "start"  # why the task is that
    switches: int = 0  # so far
    now_ns: int | None = None  # of the last facts
    clear_ns: int | None = None  # since when obstacles are far enough away to leave a level of avoidance
    found_ns: int = 0  # start of tracking
    lost: bool = False  # the target has not been seen for 3 s
    spiral_ns: int = 0  # duration of the search since then

    @property
    def avoids(self) -> bool:
        """Whether avoidance commands."""
        return self.name in CLEAR_M


def step(state: MissionState, facts: MissionFacts) -> MissionState:
    """The state at a tick, from the state at the previous tick. If time goes back, no time has passed."""
    before = facts.now_ns if state.now_ns is None else state.now_ns
    facts = facts._replace(now_ns=max(facts.now_ns, before))
    if state.now_ns is None:
        state = state._replace(since_ns=facts.now_ns)
    state = _with_task(_timed(state, facts, facts.now_ns - before), facts)
    the_task = state.task, f"nothing is near any more ({state.task_why})" if state.avoids else state.task_why
    next_mode, why = _avoidance(state, facts) or the_task
    if next_mode == state.name or (state.switches > 0 and facts.now_ns - state.since_ns < DWELL_NS):
        return state
    return state._replace(name=next_mode, since_ns=facts.now_ns, why=why, switches=state.switches + 1, clear_ns=None)


def _timed(state: MissionState, facts: MissionFacts, passed_ns: int) -> MissionState:
    clear_ns = None
    if state.name in CLEAR_M:
        begun_m = facts.first_m if state.name == "avoid1" else facts.second_m
        if facts.nearest_m > begun_m + CLEAR_M[state.name]:
            clear_ns = facts.now_ns if state.clear_ns is None else state.clear_ns
    state = state._replace(now_ns=facts.now_ns, clear_ns=clear_ns)
    if state.task != "track":
        return state
    last_seen_ns = state.found_ns if facts.seen_ns is None else max(facts.seen_ns, state.found_ns)
    lost = facts.now_ns - last_seen_ns >= LOST_NS
    return state._replace(lost=lost, spiral_ns=state.spiral_ns + passed_ns if lost and state.lost else 0)


def _with_task(state: MissionState, facts: MissionFacts) -> MissionState:
    searching: Task = "formation" if facts.shared else "search"
    if state.task == "track":
        if facts.taken:
            return _turned_to(state, searching, "another vehicle tracks the target")
        return _turned_to(state, searching, "the target is lost") if state.spiral_ns >= SPIRAL_NS else state
    if not facts.taken and facts.recognised:
        return _turned_to(state, "track", "a target is recognised")._replace(found_ns=facts.now_ns)
    if not facts.taken and facts.probability > SURE:
        why = f"the map is sure of a target, P {facts.probability:.4f}"
        return _turned_to(state, "track", why)._replace(found_ns=facts.now_ns)
    if state.task == searching:
        return state
    return _turned_to(state, searching, "the sector is shared" if facts.shared else "alone in the sector")


def _turned_to(state: MissionState, task: Task, why: str) -> MissionState:
    return state._replace(task=task, task_why=why, lost=False, spiral_ns=0)


def _avoidance(state: MissionState, facts: MissionFacts) -> tuple[Name, str] | None:
    """The due level of avoidance, and the reason; None: none."""
    near, nearer = (not facts.nearest_m >= limit_m for limit_m in (facts.first_m, facts.second_m))  # not a number is near
    has_passed = state.clear_ns is not None and facts.now_ns - state.clear_ns >= CLEAR_NS
    if nearer:
        return "avoid2", f"something at {facts.nearest_m:.2f} m, nearer than {facts.second_m:.2f} m"
    if state.name == "avoid2":
        return ("avoid1", "room for more speed") if has_passed else ("avoid2", state.why)
    if state.name == "avoid1":
        return None if has_passed else ("avoid1", state.why)
    if near and facts.closing:
        return "avoid1", f"something at {facts.nearest_m:.2f} m, nearer than {facts.first_m:.2f} m, and closing on it"
    return None
