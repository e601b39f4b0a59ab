"""``vcmvsp run``, ``study``, ``launch``, ``replay``, ``drive``, ``check``; `conduct` is their common part."""

import contextlib
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson, Changes, Sets, changes, say
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.util.text import aligned, stdout_to_stderr
from vcmvsp.cosim.view import HOST, PORT

if TYPE_CHECKING:
    from vcmvsp.cosim.runs.api import Result
    from vcmvsp.cosim.studies.engine import Studied
    from vcmvsp.cosim.view.live.foxglove_server import FoxgloveServer
    from vcmvsp.cosim.view.live.session import Viewing


ScenarioName = Annotated[str, typer.Argument(metavar="SCENARIO", help="A name that 'vcmvsp list' shows, or a .toml file.")]
Seed = Annotated[int | None, typer.Option(help="Seed [the scenario's].")]
WhereAgents = Annotated[
    str | None, typer.Option(metavar="WHERE", help="Place of the agents: inprocess, process, or zenoh (hosts started by hand).")
]
Listen = Annotated[str | None, typer.Option(metavar="ENDPOINT", help="Endpoint for hosts of agents, e.g. tls/0.0.0.0:7447.")]
KeysOfRun = Annotated[
    Path | None, typer.Option(metavar="DIR", help="Certificates for hosts on other machines ('vcmvsp keys init').")
]
Insecure = Annotated[bool, typer.Option("--insecure", help="Accept hosts without certificates from anyone in reach.")]
Realtime = Annotated[
    float | None, typer.Option(metavar="[SPEED]", help="Keep to the wall clock: SPEED simulated seconds per second (1).")
]
Twin = Annotated[bool, typer.Option("--twin", help="Simulate the scenario's real vehicles.")]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results [runs/NAME-SEED].")]
Force = Annotated[bool, typer.Option("--force", help="Write into DIR even if it is not empty.")]
View = Annotated[bool, typer.Option("--view", help="Show the run live in the browser, in real time.")]
ViewHost = Annotated[str, typer.Option(metavar="HOST", help="Address of the page; connections are not encrypted.")]
ViewPort = Annotated[int, typer.Option(metavar="PORT", min=0, max=65535, help="Port of the page; 0: any free port.")]
Foxglove = Annotated[
    int | None,
    typer.Option(
        metavar="[PORT]", min=0, max=65535, help="Stream the recording to Foxglove, in real time (port 8765; 0: any)."
    ),
]
FoxgloveHost = Annotated[str, typer.Option(metavar="HOST", help="Address of the Foxglove stream, which has no access control.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only errors.")]


def run_command(
    context: typer.Context,
    scenario: ScenarioName,
    seed: Seed = None,
    set_: Sets = None,
    agents: WhereAgents = None,
    listen: Listen = None,
    keys: KeysOfRun = None,
    insecure: Insecure = False,
    realtime: Realtime = None,
    out: Out = None,
    force: Force = False,
    json: AsJson = False,
    quiet: Quiet = False,
    twin: Twin = False,
    view: View = False,
    view_host: ViewHost = HOST,
    view_port: ViewPort = PORT,
    foxglove: Foxglove = None,
    foxglove_host: FoxgloveHost = HOST,
) -> None:
    """Run a scenario and write recording, tables, metrics and figures.

    Example: vcmvsp run formation-circle --set radio.loss.probability=0.5 --seed 7 --out lossy
    """
    page = (view_host, view_port) if view else None
    options: dict[str, Any] = {"agents": agents, "listen": listen, "keys": keys, "insecure": insecure, "force": force}
    options["drawer"] = context.obj
    with contextlib.ExitStack() as stack:
        sets = simulated(scenario, set_ or []) if twin else set_ or []
        if foxglove is not None:
            options["sink"] = stack.enter_context(foxglove_stream(foxglove_host, foxglove))
            realtime = realtime or 1.0
        conduct(None, scenario, sets, out, seed=seed, realtime=realtime, json=json, quiet=quiet, page=page, **options)


def launch_command(
    scenario: ScenarioName,
    hosts: Annotated[Path, typer.Option(metavar="FILE", help="File with the hosts of the agents, e.g. hosts.toml.")],
    seed: Seed = None,
    set_: Sets = None,
    listen: Listen = None,
    keys: KeysOfRun = None,
    insecure: Insecure = False,
    realtime: Realtime = None,
    out: Out = None,
    force: Force = False,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run a scenario, and start hosts for its agents on other machines, through ssh.

    The output of hosts is shown and written to DIR/hosts. Hosts end with the run, however it ends.

    Example: vcmvsp launch formation-circle --hosts hosts.toml --listen tls/0.0.0.0:7447 --keys keys
    """
    from vcmvsp.cosim.runs.launch import launch

    start = functools.partial(launch, hosts=hosts)
    options: dict[str, Any] = {"listen": listen, "keys": keys, "insecure": insecure, "force": force}
    conduct(start, scenario, set_ or [], out, seed=seed, realtime=realtime, json=json, quiet=quiet, **options)


def replay_command(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="Folder of a run.")],
    seed: Seed = None,
    set_: Sets = None,
    agents: WhereAgents = None,
    twin: Annotated[bool, typer.Option("--twin", help="Simulate vehicles that were real in the run.")] = False,
    radio: Annotated[
        str, typer.Option(metavar="HOW", help="Receptions: drawn (simulated again) or recorded (as in the run).")
    ] = "drawn",
    listen: Listen = None,
    keys: KeysOfRun = None,
    insecure: Insecure = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results [RUN_DIR-replay].")] = None,
    force: Force = False,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Repeat a recorded run, changed or unchanged: recorded input of real vehicles, algorithms executed again.

    An unchanged replay gives equal numbers, or prints the cause of differences (exit code 1).

    Classes from Python files are those that the run copied to RUN_DIR.

    Example: vcmvsp replay runs/formation-circle-1 --set agents.estimator=hold
    """
    from vcmvsp.cosim.runs.replay import beside, check, comparison, replay

    check(run_dir, out, radio)

    def again(_: str, **options: Any) -> "Result":
        return replay(run_dir, **{**options, "numbered": out is None}, twin=twin, radio=radio)

    scenario, folder = str(run_dir / "scenario.toml"), beside(run_dir) if out is None else out
    options: dict[str, Any] = {"agents": agents, "listen": listen, "keys": keys, "insecure": insecure, "force": force}
    result = conduct(again, scenario, set_ or [], folder, seed=seed, realtime=None, json=json, quiet=quiet, **options)
    if seed is None and not set_ and not twin:
        same, words = comparison(run_dir, result)
        if not (same and quiet):
            say(words)
        if not same:
            raise typer.Exit(1)


DEMO: Mapping[str, Mapping[str, Any]] = {
    "no-loss": {"radio.loss.probability": 0.0, "radio.delay.seconds": 0.0, "radio.delay.jitter_s": 0.0},
    "hold": {"agents.estimator": "hold"},
    "dead-reckoning": {"agents.estimator": "dr"},
}
"""Runs of formation-slalom, by name: what each changes."""


def demo_command(
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results [runs/demo].")] = None,
    force: Force = False,
    quiet: Quiet = False,
) -> None:
    """Run a formation three times, with a perfect radio and with one that loses half of all messages, and compare.

    With losses, followers first take the last message as it is (hold), then extrapolate it (dead reckoning).

    Example: vcmvsp demo
    """
    from vcmvsp.cosim.runs import api
    from vcmvsp.cosim.terminal.progress import Progress
    from vcmvsp.cosim.util.files import Folder

    folder = Folder(out or Path("runs/demo"), force=force, numbered=out is None).claim()
    lines = [["run", "lost", "age", "formation error, RMS"]]
    for name, settings in DEMO.items():
        with stdout_to_stderr(), Progress(quiet=quiet) as progress:
            callbacks: dict[str, Any] = {"progress": progress.on_instant, "tell": progress.tell}
            result = api.run("formation-slalom", set=settings, out=folder / name, force=force, **callbacks)
        radio, error_m = result.metrics["radio"], result.metrics["formation"]["rms_m"]
        lost, age_ms = 100.0 * (1.0 - radio["delivery_ratio"]), 1000.0 * radio["age_s"]["mean"]
        lines.append([name, f"{lost:.0f} %", f"{age_ms:.0f} ms", f"{error_m:.3f} m"])
    (picture,) = api.plot([folder / name for name in DEMO], folder)
    sys.stdout.write("".join(f"{line}\n" for line in aligned(lines)))
    sys.stdout.write(f"picture: {picture}\nresults: {', '.join(str(folder / name) for name in DEMO)}\n")


def drive_command(
    scenario: ScenarioName,
    vehicle: Annotated[str, typer.Option(metavar="NAME", help="Which one.")],
    command: Annotated[
        str,
        typer.Option(
            metavar="COMMAND", help="v=0.3,w=0.5 (forward, yaw rate), vx=,vy=,vz=,w= or x=,y=,z=[,yaw=][,speed=] in the air."
        ),
    ],
    seconds: Annotated[float, typer.Option(metavar="S", help="Duration, s.")] = 10.0,
    set_: Sets = None,
    json: AsJson = False,
) -> None:
    """Send one command to one vehicle at the start and print its response; all others stand still.

    Example: vcmvsp drive lab-patrol --vehicle ugv1 --command "v=0.3,w=0.5" --seconds 5
    """
    from vcmvsp.cosim.runs import step_response
    from vcmvsp.cosim.scenario import loader as scenarios
    from vcmvsp.cosim.util.files import to_json

    with stdout_to_stderr():
        about = step_response.drive(scenario, vehicle, command, seconds, scenarios.settings_of(set_ or []))
    sys.stdout.write(to_json(about) if json else step_response.summary(about))


def check_command(scenario: ScenarioName, set_: Sets = None) -> None:
    """Check all keys, kinds and periods of a scenario: import and start its classes without a simulation.

    Example: vcmvsp check my_scenario.toml
    """
    from vcmvsp.cosim.runs import api
    from vcmvsp.cosim.scenario import loader as scenarios

    with stdout_to_stderr():
        resolved = api.check(scenario, set=scenarios.settings_of(set_ or []), tell=say)
    sys.stdout.write(f"{scenario}: fine ({len(resolved['vehicle'])} vehicles, {resolved['duration_s']:g} s)\n")


def simulated(scenario: str, sets: Sequence[str]) -> list[str]:
    """The ``--set`` arguments, extended so that real vehicles are simulated."""
    from vcmvsp.cosim.scenario import loader as scenarios

    parsed, _ = scenarios.load(scenario, settings=scenarios.settings_of(sets))
    return [*sets, *(f"{key}={value}" for key, value in parsed.twins.items())]


def conduct(
    start: "Callable[..., Result] | None",
    scenario: str,
    sets: Sequence[str],
    out: Path | None,
    *,
    seed: int | None,
    realtime: float | None,
    json: bool,
    quiet: bool,
    page: tuple[str, int] | None = None,
    **options: object,
) -> "Result":
    """Call `vcmvsp.run`, or ``start`` in its place; show progress and results, also on a page if one is asked for."""
    from vcmvsp.cosim.runs import api
    from vcmvsp.cosim.scenario import loader as scenarios
    from vcmvsp.cosim.terminal.progress import Progress, lateness, summary
    from vcmvsp.cosim.util.files import to_json

    if out is not None and str(out) == ".":
        raise UsageError("--out: name a folder; the files of a run cannot go into the current folder")
    settings = scenarios.settings_of(sets)
    loaded = scenarios.load(scenario, settings=settings, seed=seed)
    parsed = loaded.scenario
    kinds = {each.name: each.agent.kind or "" for each in parsed.vehicle if each.agent is not None}
    default = Path("runs") / f"{parsed.name}-{parsed.seed}"
    run = functools.partial(start, scenario, seed=seed, set=settings) if start else functools.partial(api.run, loaded)
    with contextlib.ExitStack() as stack:
        viewing = None if page is None else stack.enter_context(control_station(page))
        if viewing is not None:
            options["view"] = viewing
        with stdout_to_stderr(), Progress(quiet=quiet) as progress:
            result = run(
                realtime=realtime,
                out=out or default,
                numbered=out is None,
                progress=progress.on_instant,
                tell=progress.tell,
                observe=progress.observer(kinds),
                **options,
            )
        if json:
            sys.stdout.write(to_json(result.metrics))
        elif not quiet:
            sys.stdout.write(summary(result))
        elif (late := result.about["lateness"]) and late["over_one_period"]:
            sys.stderr.write(f"vcmvsp: {lateness(late)}\n")
        if viewing is not None and sys.stderr.isatty():
            sys.stdout.flush()
            sys.stderr.write("The page shows the end of the run until you press Ctrl-C.\n")
            viewing.stay()
    return result


def control_station(page: tuple[str, int]) -> "Viewing":
    """The page of a live run; its address is printed even with ``--quiet``."""
    from vcmvsp.cosim.view.live.session import Viewing
    from vcmvsp.cosim.view.web_server import caution

    def opened(url: str) -> None:
        sys.stderr.write(f"control station: {url}\n{caution(page[0])}")
        sys.stderr.flush()

    return Viewing(*page, opened=opened)


def foxglove_stream(host: str, port: int) -> "FoxgloveServer":
    """The stream of a live run for Foxglove; its address is printed even with ``--quiet``."""
    from vcmvsp.cosim.view.live.foxglove_server import FoxgloveServer, caution

    def opened(url: str) -> None:
        sys.stderr.write(f"Foxglove: open a connection, Foxglove WebSocket, {url}\n{caution(host)}")
        sys.stderr.flush()

    return FoxgloveServer(host, port, opened)


SHOWN = 40  # points of a study in the terminal's table


def study_command(
    scenario: ScenarioName,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES", help="KEY=a,b,c or KEY=start:stop:step; repeat for a grid [the scenario's [study] table]."
        ),
    ] = None,
    seeds: Annotated[int | None, typer.Option(metavar="N", help="Runs per point [the scenario's, else 20].")] = None,
    metric: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Metric to plot and summarise, e.g. formation.rms_m; repeat for several."),
    ] = None,
    set_: Annotated[Changes, changes("Change a key of the scenario for all runs.")] = None,
    seed: Annotated[int | None, typer.Option(help="First seed [the scenario's].")] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", help="Number of parallel runs [number of cores].")] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on the workers of this Dask scheduler, e.g. tcp://10.0.0.1:8786.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results [runs/NAME-study].")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue the study in DIR; values and seeds may be added.")] = False,
    force: Force = False,
    twin: Twin = False,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run a scenario over a grid of values, with the same seeds at each point.

    Example: vcmvsp study formation-slalom --vary radio.loss.probability=0:0.8:0.2 --vary agents.estimator=hold,dr --seeds 5
    """
    from vcmvsp.cosim.scenario import loader as scenarios
    from vcmvsp.cosim.studies import engine
    from vcmvsp.cosim.studies.plan import vary_of
    from vcmvsp.cosim.terminal.progress import StudyProgress

    if out is not None and str(out) == ".":
        raise UsageError("--out: name a folder; the files of a study cannot go into the current folder")
    settings = scenarios.settings_of(simulated(scenario, set_ or []) if twin else set_ or [])
    with stdout_to_stderr(), StudyProgress(quiet=quiet) as progress:
        studied = engine.conduct(
            scenario,
            vary=vary_of(vary or []),
            seeds=seeds,
            seed=seed,
            settings=settings,
            metrics=metric,
            jobs=jobs,
            cluster=cluster,
            out=out or (None if resume else Path("runs") / f"{Path(scenario).stem}-study"),
            numbered=out is None,
            resume=resume,
            force=force,
            progress=progress.on_run,
            checking=progress.on_check,
            noted=progress.on_value,
            tell=progress.tell,
        )
    failed = [text for text in studied.table["error"].to_pylist() if text is not None]
    _show_study(studied, len(failed), json=json, quiet=quiet)
    if failed:
        which = "every run" if len(failed) == studied.plan.size else f"{len(failed)} of {studied.plan.size} runs"
        raise VcmvspError(f"{which} failed, the first with: {failed[0]}")


def _show_study(studied: "Studied", failed: int, *, json: bool, quiet: bool) -> None:
    from vcmvsp.cosim.studies.summary import rows, summarise
    from vcmvsp.cosim.util.files import to_json

    plan = studied.plan
    summary = summarise(studied.table, list(plan.vary), plan.metrics)
    points = rows(summary, list(plan.vary), plan.metrics)
    if json:
        about = {"scenario": plan.scenario, "vary": plan.vary, "seeds": plan.seeds, "runs": plan.size, "failed": failed}
        sys.stdout.write(to_json({**about, "rows": points, "out": str(studied.folder)}))
    elif not quiet:
        sys.stdout.write(f"{plan.scenario}: {plan.size} runs, {len(points)} points with {len(plan.seeds)} seeds each\n")
        sys.stdout.write(_table(points, list(plan.vary), plan.metrics))
        sys.stdout.write(f"results: {studied.folder}\n")


def _table(points: Sequence[Mapping[str, Any]], keys: Sequence[str], metrics: Sequence[str]) -> str:
    lines = [[*keys, "n", *metrics]]
    for point in points[:SHOWN]:
        values = [str(point[key]) for key in (*keys, "n")]
        lines.append([*values, *(_band(point[name]) for name in metrics)])
    text = "".join(f"{line}\n" for line in aligned(lines))
    return text + (f"... and {len(points) - SHOWN} more points, in summary.csv\n" if len(points) > SHOWN else "")


def _band(statistics: Mapping[str, float | None]) -> str:
    if statistics["mean"] is None:
        return "-"
    band = "" if statistics["low"] is None else f" [{statistics['low']:.4g}, {statistics['high']:.4g}]"
    return f"{statistics['mean']:.4g}{band}"
