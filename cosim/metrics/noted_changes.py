"""What agents noted of their way past obstacles: modes, shapes of a team, whether the lane ahead of its leader was free.

A value holds from the time at which an agent noted it (`cosim.agent.Agent.note`) until it notes another one; the first is no
change. A mode says that a vehicle is on its way around something if it is ``avoid`` or ``turn``; to stand and see nothing,
``blind``, is none of that, and no more is a mode of anybody's own.
"""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.tables.schema import Placement

AROUND = ("avoid", "turn")  # modes of one that gets around something
FREE = "free"  # of a lane; else it is narrow

History = Sequence[tuple[int, Any]]  # ns and value, each unlike the one before it


class Noted:
    """Every change of the values that count here, as the notes of a run come in."""

    def __init__(self) -> None:
        self._histories: dict[tuple[str, str], list[tuple[int, Any]]] = {}

    def take(self, vehicle: str, time_ns: int, values: Mapping[str, Any]) -> None:
        """What an agent noted at a time."""
        for name in ("mode", "shape", "lane"):
            if name in values:
                history = self._histories.setdefault((vehicle, name), [])
                if not history or history[-1][1] != values[name]:
                    history.append((time_ns, values[name]))

    def of(self, vehicle: str, name: str) -> History:
        """The values that it noted under this name."""
        return self._histories.get((vehicle, name), ())


def change_metrics(noted: Noted, vehicles: Iterable[str], tellers: Iterable[str], end_ns: int) -> dict[str, Any]:
    """Changes of the shape that ``tellers`` noted, changes to modes that lead around something and back, and time (s) in those.

    Of modes it is None where nobody notes any.
    """
    modes = [history for name in vehicles if (history := noted.of(name, "mode"))]
    return {
        "shape_changes": sum(max(0, len(noted.of(name, "shape")) - 1) for name in tellers),
        "mode_toggles": sum(_toggles(history) for history in modes) if modes else None,
        "avoid_s": sum(_away_ns(history, end_ns) for history in modes) / SECOND_NS if modes else None,
    }


def leaders(names: Iterable[str], follows: Sequence[Placement]) -> list[str]:
    """Those who lead teams: they are followed, and never follow."""
    followed, following = {each.follows.leader for each in follows}, {each.vehicle for each in follows}
    return [name for name in names if name in followed and name not in following]


def led_by(name: str, follows: Sequence[Placement]) -> str:
    """Who leads the team of a follower: whom it followed last, whom that one did, and so on up."""
    above = {each.vehicle: each.follows.leader for each in follows if each.follows.leader is not None}
    for _ in above:  # at most: nobody follows himself, however he may do so
        name = above.get(name, name)
    return name


def reformed_s(noted: Noted, settled: Mapping[str, float | None]) -> float | None:
    """How long after the lane of its leader was free all of a team had settled, s; of the team that took longest.

    None where no lane was ever narrow, and where a team has not formed again: its lane is narrow to the end, not all of it have
    settled, or it has to the end kept the shape that it took while its lane was narrow.

    Args:
        noted: by leaders.
        settled: when all who count of a team had settled, s; by its leader.
    """
    taken = []
    for leader, settled_s in settled.items():
        lane, shapes = noted.of(leader, "lane"), noted.of(leader, "shape")
        if all(state == FREE for _, state in lane):
            continue
        changed_ns = shapes[-1][0] if shapes else -1
        then = [state for time_ns, state in lane if time_ns <= changed_ns]
        if settled_s is None or lane[-1][1] != FREE or (then and then[-1] != FREE):
            return None
        taken.append(round(max(0.0, settled_s - lane[-1][0] / SECOND_NS), 9))
    return max(taken, default=None)


def _toggles(modes: History) -> int:
    """How often it began to get around something, or had done so."""
    return sum((before in AROUND) != (after in AROUND) for (_, before), (_, after) in pairwise(modes))


def _away_ns(modes: History, end_ns: int) -> int:
    """How long it was getting around something."""
    return sum(end - begin for (begin, mode), (end, _) in pairwise([*modes, (end_ns, None)]) if mode in AROUND)
