"""What is wrong with a study, found before its first run: unknown keys, values out of range, unknown metrics."""

import difflib
import hashlib
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from typing import Any, Literal

import msgspec

from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.errors import AgentError, ScenarioError, UsageError, VcmvspError
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.studies.plan import Base, Plan
from vcmvsp.cosim.studies.rows import flat

PACKAGES = ("vcmvsp", "numpy", "scipy", "pybullet", "simpy", "pyarrow")
ALL_CHECKED = 50  # points; of more, every value of every key is checked once: each takes a tenth of a second
FORMATION = ("formation.rms_m", "radio.delivery_ratio")
NO_FORMATION = ("radio.delivery_ratio", "radio.age_s.mean")


def examined(plan: Plan, base: Base, checking: Callable[[int, int], None] = lambda *_: None) -> Plan:
    """The plan with its metrics, files and versions, if every run can begin.

    Args:
        plan: what is asked for.
        base: the scenario.
        checking: told before each point how many are checked, and of how many.

    Raises:
        ScenarioError: a point cannot be run as it is.
        UsageError: a metric is unknown.
    """
    hashes: dict[str, set[str]] = {}
    chosen = list(_chosen(plan))
    for number, point in enumerate(chosen):
        checking(number, len(chosen))
        for name, content in _check(plan, base, point).items():
            hashes.setdefault(name, set()).add(hashlib.sha256(content).hexdigest())
    files = {name: " ".join(sorted(found)) for name, found in hashes.items()}
    versions = {name: metadata.version(name) for name in PACKAGES}
    return msgspec.structs.replace(plan, metrics=_metrics(plan, base), files=files, versions=versions)


def where(plan: Plan, base: Base) -> Literal["inprocess"] | None:
    """Where agents of the runs run, if not where the scenario says: nobody starts hosts by hand for each run of a study."""
    parsed, _ = loader.load(base.asked, settings=plan.set)
    return "inprocess" if _by_hand(parsed) else None


def _by_hand(parsed: Scenario) -> bool:
    return "zenoh" in {parsed.agents.runs, *(each.agent.runs for each in parsed.vehicle if each.agent)}


def _chosen(plan: Plan) -> Iterator[tuple[Any, ...]]:
    """The points that are checked."""
    values = list(plan.vary.values())
    if plan.size <= ALL_CHECKED * len(plan.seeds):
        yield from plan.points
        return
    first = tuple(each[0] for each in values)
    yield first
    for place, each in enumerate(values):
        yield from ((*first[:place], value, *first[place + 1 :]) for value in each[1:])


def _check(plan: Plan, base: Base, point: tuple[Any, ...]) -> Mapping[str, bytes]:
    """Build and start a point's federates once; the files that it uses."""
    settings = plan.settings(point)
    files: Mapping[str, bytes] = {}
    try:
        parsed, source = loader.load(base.asked, settings=settings, seed=plan.seeds[0])
        if parsed.bridge.doors or parsed.sockets.vehicles:
            raise UsageError("a study has no programs to talk to: leave [bridge] and [sockets] out")
        if parsed.real:
            raise UsageError(f"a study drives no real vehicles ({', '.join(parsed.real)}): simulate them with --twin")
        with assemble(parsed, source, runs="inprocess" if _by_hand(parsed) else "here") as assembled:
            assembled.resolved()  # only then are all files known
            files = assembled.files
            kernel = Kernel(assembled.info, assembled.federates)
            assembled.start(kernel)
            kernel.close()
    except ScenarioError as error:
        asked = re.match(r"--set (\S+)=", error.source)
        if asked and asked[1] in plan.vary:  # the user said --vary
            raise ScenarioError(error.problem, key=error.key, source=error.source.replace("--set", "--vary", 1)) from error
        raise
    except AgentError:  # that is for the runs to show
        pass
    return files


def _metrics(plan: Plan, base: Base) -> list[str]:
    """The metrics that are asked for, or those that say most; all of them exist."""
    first, last = (tuple(values[place] for values in plan.vary.values()) for place in (0, -1))
    names = _names(plan, base, first)
    if not plan.metrics:
        return list(FORMATION if any(name.startswith("formation.per_follower.") for name in names) else NO_FORMATION)
    if names and not _known(plan.metrics, names):
        names |= _names(plan, base, last)  # which may have vehicles that the first has not
    for name in plan.metrics:
        if names and not _known([name], names):
            near = difflib.get_close_matches(name, names, n=1)
            listed = ", ".join(sorted(each for each in names if ".per_" not in each))
            guess = f"; did you mean '{near[0]}'?" if near else ""
            raise UsageError(f"--metric {name}: unknown metric{guess} (allowed: {listed}, and those of each vehicle)")
    return list(dict.fromkeys(plan.metrics))


def _known(metrics: Sequence[str], names: set[str]) -> bool:
    """Whether all of these exist; a cause of losses may turn up in one run alone."""
    return all(name in names or name.startswith("radio.losses.") for name in metrics)


def _names(plan: Plan, base: Base, point: tuple[Any, ...]) -> set[str]:
    """The metrics that are numbers, from a run that is cut short; none if that fails."""
    settings = plan.settings(point)
    try:
        parsed, _ = loader.load(base.asked, settings=settings)
        short = {**settings, "duration_s": min(parsed.duration_s, parsed.record.period_s)}
        result = api.run(base.asked, seed=plan.seeds[0], set=short, agents="inprocess", mcap=False)
    except VcmvspError:
        return set()
    return {name for name, value in flat(result.metrics).items() if not isinstance(value, str) and name not in plan.vary}
