"""``vcmvsp.study``, the engine of ``vcmvsp study``: from the arguments to the table, in order of execution."""

import contextlib
import difflib
import functools
import hashlib
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import msgspec

from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.errors import AgentError, Interrupted, ScenarioError, UsageError, VcmvspError
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.metrics.catalogue import METRICS
from vcmvsp.cosim.processes.worker_pool import Answered, Pool, cores
from vcmvsp.cosim.runs import api, notebook
from vcmvsp.cosim.scenario import loader
from vcmvsp.cosim.scenario.schema import Scenario
from vcmvsp.cosim.studies import plan as plans
from vcmvsp.cosim.studies import rows
from vcmvsp.cosim.studies.plan import Base, Plan
from vcmvsp.cosim.studies.rows import flat
from vcmvsp.cosim.studies.store import Answers, Store, begun
from vcmvsp.cosim.studies.worker import DIED, Job, Work, WorkersGoneError, run_one, version
from vcmvsp.cosim.util.files import Folder, to_json, write_whole, writing
from vcmvsp.cosim.util.text import Tell
from vcmvsp.cosim.util.versions import versions_of

if TYPE_CHECKING:
    import pyarrow as pa


Progress = Callable[[int, int, int], None]
Checking = Callable[[int, int], None]
Noted = Callable[[str, float], None]
ABOUT_SCHEMA = "vcmvsp.study-about/1"


class Studied(NamedTuple):
    """Result of a study."""

    table: "pa.Table"
    plan: Plan
    folder: Path | None


def study(
    scenario: str | Path | Mapping[str, Any],
    *,
    vary: Mapping[str, Sequence[Any] | str] | None = None,
    seeds: int | None = None,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    metrics: Sequence[str] | None = None,
    jobs: int | None = None,
    cluster: object = None,
    out: str | Path | None = None,
    resume: bool = False,
    force: bool = False,
    progress: Progress | None = None,
) -> "pa.Table":
    """Run a scenario at every combination of values, with the same seeds at each.

    Args:
        scenario: a built-in name, the path of a TOML file, or its content as a mapping.
        vary: key path -> values, e.g. ``{"radio.loss.probability": [0.0, 0.3]}``, or as text, ``"0:0.9:0.1"``. Defaults of
            ``vary``, ``seeds`` and ``metrics`` come from ``[study]`` of the scenario.
        seeds: runs of each combination.
        seed: the first seed, replacing the scenario's.
        set: key path -> value, for all runs.
        metrics: metrics to draw and summarise; the table has all.
        jobs: parallel runs on this machine; default: one per core.
        cluster: run on this Dask cluster instead: address of the scheduler, e.g. ``tcp://10.0.0.1:8786``, or cluster object.
        out: folder for ``study.parquet``, summary, figures and report; without it nothing is written.
        resume: continue the study in ``out``; values and seeds may have been added. Failed runs are repeated.
        force: write into a folder that is not empty.
        progress: called with (done, failed, total) runs; default: in Jupyter, a bar.

    Returns:
        A row per run, point by point: the varied keys, ``seed``, every number of the run's metrics by its path, ``error`` (null
        where the run succeeded) and ``digest``.

    Raises:
        ScenarioError, UsageError: a run could not start; raised before the first run.
        Interrupted: Ctrl-C; finished runs are in ``out``.
    """
    return conduct(
        scenario, vary=vary, seeds=seeds, seed=seed, settings=set or {}, metrics=metrics, jobs=jobs, cluster=cluster,
        out=None if out is None else Path(out), resume=resume, force=force, progress=progress or _bar(),
    ).table  # fmt: skip


def _bar() -> Progress:
    """A bar in Jupyter."""
    show = notebook.bar("study")
    return lambda done, _, total: None if show is None else show(done, total)


def conduct(
    scenario: str | Path | Mapping[str, Any],
    *,
    vary: Mapping[str, Sequence[Any] | str] | None,
    seeds: int | None,
    seed: int | None,
    settings: Mapping[str, Any],
    metrics: Sequence[str] | None,
    jobs: int | None,
    cluster: object,
    out: Path | None,
    resume: bool,
    force: bool,
    progress: Progress,
    checking: Checking = lambda *_: None,
    noted: Noted = lambda *_: None,
    tell: Tell = lambda _: None,
    numbered: bool = False,
) -> Studied:
    """Run a study as `study` does, and return its plan and folder too.

    Args:
        checking: called with (checked, total) points before the first run.
        noted: called with the name of the first metric and its value after each run.
        tell: receives lines for the user before the first run, each once.
        numbered: if ``out`` exists, use ``out-2``, ``out-3``, ...
    """
    started, begin = datetime.now(UTC), time.monotonic()
    _check_arguments(jobs, cluster, out, resume=resume, force=force)
    stored = None
    if out is not None and not numbered:
        with writing(out):
            stored = begun(out, resume=resume, force=force)
    base = plans.base_of(scenario)
    plan = plans.make(base, vary=vary, seeds=seeds, seed=seed, settings=settings, metrics=metrics, stored=stored)
    plan = examined(plan, base, checking, tell)
    work = Work(plan.scenario_toml, str(base.folder), version(), place_of_agents(plan, base), plan.files)
    with _workers(work, jobs, cluster) as ask:
        if out is not None and numbered:
            with writing(out):
                out = Folder(out, numbered=True).claim()
        opened = Store(out, plan, resume=resume, force=force) if out else contextlib.nullcontext(Answers(plan))
        with opened as answers:
            before = len(answers.rows)
            try:
                _run(plan, answers, ask, progress, noted)
            except (KeyboardInterrupt, WorkersGoneError) as error:
                again = "; the same command with --resume goes on" if out else ""
                status = f"{len(answers.rows)} of {plan.size} runs are done{again}"
                raise (VcmvspError(f"{error}: {status}") if str(error) else Interrupted(f"interrupted: {status}")) from None
            table = answers.finish()
            if out is not None:
                about = _about(plan, started, time.monotonic() - begin, plan.size - before, cluster=cluster, jobs=jobs)
                _write(out, table, plan, about, repeatable=not isinstance(scenario, Mapping))
    return Studied(table, plan, out)


Ask = Callable[[Iterator[tuple[plans.Run, Job]], int], Iterator[Answered]]


def _run(plan: Plan, answers: Answers, ask: Ask, progress: Progress, noted: Noted) -> None:
    total, done, failed = plan.size, len(answers.rows), 0
    finished = frozenset(answers.rows)
    jobs = ((run, Job(run.seed, plan.settings(run.point))) for run in plan.runs if run.key not in finished)
    progress(done, failed, total)
    for run, row in ask(jobs, total - done):
        answers.add(run.key, row)
        answer = rows.decode(row)
        done, failed = done + 1, failed + (answer.error is not None)
        for name in plan.metrics[:1]:
            if isinstance(value := answer.values.get(name), int | float):
                noted(name, value)
        progress(done, failed, total)


@contextlib.contextmanager
def _workers(work: Work, jobs: int | None, cluster: object) -> Iterator[Ask]:
    if cluster is None:
        with Pool(functools.partial(run_one, work), jobs or cores(), died=DIED, imports=(run_one.__module__,)) as pool:
            yield pool.answers
    else:
        from vcmvsp.cosim.studies.worker import Cluster

        with Cluster(work, cluster) as connected:
            yield connected.answers


def _write(out: Path, table: "pa.Table", plan: Plan, about: Mapping[str, Any], *, repeatable: bool) -> None:
    from vcmvsp.cosim.studies import outputs

    with writing(out):
        outputs.write(out, table, plan, repeatable=repeatable)
        write_whole(out / "about.json", to_json(about))


def _check_arguments(jobs: int | None, cluster: object, out: Path | None, *, resume: bool, force: bool) -> None:
    if jobs is not None and jobs < 1:
        raise UsageError(f"--jobs {jobs}: must be at least 1")
    if jobs is not None and cluster is not None:
        raise UsageError("--jobs and --cluster exclude each other: the cluster sets the number of workers")
    if resume and out is None:
        raise UsageError("--resume needs --out with the folder of the study")
    if resume and force:
        raise UsageError("--resume (continue) and --force (start again) exclude each other: leave one out")


def _about(
    plan: Plan, started: datetime, wall_s: float, runs_made: int, *, cluster: object, jobs: int | None
) -> dict[str, Any]:
    """Facts about a study that differ between two equal studies."""
    return {
        "schema": ABOUT_SCHEMA,
        "started": started.isoformat(),
        "wall_s": wall_s,
        "runs": plan.size,
        "runs_made": runs_made,  # the others were resumed
        "where": f"{jobs or cores()} jobs" if cluster is None else str(cluster),
        "host": api.host_facts(),
        "versions": plan.versions,
    }


PACKAGES = ("vcmvsp", "numpy", "scipy", "pybullet", "mujoco-core", "simpy", "pyarrow")
ALL_CHECKED = 50  # points; in larger grids, every value of every key is checked once, about 0.1 s each
FORMATION = ("formation.rms_m", "radio.delivery_ratio")
NO_FORMATION = ("radio.delivery_ratio", "radio.age_s.mean")


def examined(plan: Plan, base: Base, checking: Checking = lambda *_: None, tell: Tell = lambda _: None) -> Plan:
    """Check that every run can start, and complete the plan with metrics, files and versions.

    Args:
        checking: called with (checked, total) before each point.
        tell: receives remarks on the points, each once.

    Raises:
        ScenarioError: a point cannot be run as it is.
        UsageError: a metric is unknown.
    """
    hashes: dict[str, set[str]] = {}
    lines: list[str] = []
    chosen = list(_chosen(plan))
    for number, point in enumerate(chosen):
        checking(number, len(chosen))
        for name, content in _check(plan, base, point, lines.append).items():
            hashes.setdefault(name, set()).add(hashlib.sha256(content).hexdigest())
    for line in dict.fromkeys(lines):
        tell(line)
    files = {name: " ".join(sorted(digests)) for name, digests in hashes.items()}
    versions = versions_of(PACKAGES)
    return msgspec.structs.replace(plan, metrics=_metrics(plan, base), files=files, versions=versions)


def place_of_agents(plan: Plan, base: Base) -> Literal["inprocess"] | None:
    """Place of the agents that overrides the scenario's: in this process instead of manually started hosts."""
    parsed, _ = loader.load(base.asked, settings=plan.set)
    return "inprocess" if _by_hand(parsed) else None


def _by_hand(parsed: Scenario) -> bool:
    return "zenoh" in {parsed.agents.runs, *(each.agent.runs for each in parsed.vehicle if each.agent)}


def _chosen(plan: Plan) -> Iterator[tuple[Any, ...]]:
    values = list(plan.vary.values())
    if plan.size <= ALL_CHECKED * len(plan.seeds):
        yield from plan.points
        return
    first = tuple(each[0] for each in values)
    yield first
    for place, each in enumerate(values):
        yield from ((*first[:place], value, *first[place + 1 :]) for value in each[1:])


def _check(plan: Plan, base: Base, point: tuple[Any, ...], tell: Tell) -> Mapping[str, bytes]:
    """Build and start a point's federates once; returns the files that it uses."""
    settings = plan.settings(point)
    files: Mapping[str, bytes] = {}
    try:
        parsed, source = loader.load(base.asked, settings=settings, seed=plan.seeds[0])
        if parsed.bridge.doors or parsed.sockets.vehicles or parsed.stack:
            raise UsageError("a study cannot run external programs: leave [bridge], [sockets] and [stack] out")
        if parsed.real:
            raise UsageError(f"a study cannot drive real vehicles ({', '.join(parsed.real)}): simulate them with --twin")
        with assemble(parsed, source, runs="inprocess" if _by_hand(parsed) else "here", tell=tell) as assembled:
            assembled.resolved()  # only now all files are known
            files = assembled.resolution.files
            kernel = Kernel(assembled.info, assembled.federates)
            assembled.start(kernel)
            kernel.close()
    except ScenarioError as error:
        match = re.match(r"--set (\S+)=", error.source)
        if match and match[1] in plan.vary:  # set by --vary
            raise ScenarioError(error.problem, key=error.key, source=error.source.replace("--set", "--vary", 1)) from error
        raise
    except AgentError:  # the runs will report it
        pass
    return files


def _metrics(plan: Plan, base: Base) -> list[str]:
    """The requested metrics, checked, or the default ones."""
    names = _names(plan, base, 0)
    if not plan.metrics:
        has_followers = any(name.startswith("formation.per_follower.") for name in names)
        return list(FORMATION if has_followers else NO_FORMATION)
    if names and not _exist(plan.metrics, names):
        names |= _names(plan, base, -1)  # may have more vehicles than the first
    for name in plan.metrics:
        if names and not _exist([name], names):
            near = difflib.get_close_matches(name, names, n=1)
            listed = ", ".join(sorted(each for each in names if ".per_" not in each))
            guess = f"; did you mean '{near[0]}'?" if near else ""
            if name.startswith("note."):
                note = name.removeprefix("note.")
                guess = f"; for what agents note: [metrics.own] {note} = {{ note = '{note}' }}, and --metric own.{note}"
            raise UsageError(f"--metric {name}: unknown metric{guess} (allowed: {listed}, and those of each vehicle)")
    return list(dict.fromkeys(plan.metrics))


def _exist(metrics: Sequence[str], names: set[str]) -> bool:
    """Whether all metrics exist; every loss cause is accepted, since it may occur in a single run only."""
    return all(name in names or name.startswith("radio.losses.") for name in metrics)


def _names(plan: Plan, base: Base, place: int) -> set[str]:
    """Names of the numeric metrics, from a shortened run with the values at this place; empty if it fails."""
    settings = plan.settings(tuple(values[place] for values in plan.vary.values()))
    try:
        parsed, _ = loader.load(base.asked, settings=settings)
        short = {**settings, "duration_s": min(parsed.duration_s, parsed.record.period_s)}
        result = api.run(base.asked, seed=plan.seeds[0], set=short, agents="inprocess", mcap=False)
    except VcmvspError as error:
        if error.result is None:
            return set()
        result = error.result  # of an own metric that fails on so short a run
    names = {name for name, value in flat(result.metrics).items() if not isinstance(value, str) and name not in plan.vary}
    if parsed.routing:
        names |= {name for name in METRICS if name.startswith("routing.")}
    return names
