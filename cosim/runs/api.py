"""``vcmvsp.run``: a scenario in, a `Result` out. What the command line does, notebooks and studies do through here."""

import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from vcmvsp.cosim.agent import Agent
from vcmvsp.cosim.assembly import real_vehicles
from vcmvsp.cosim.assembly.run import assemble, clock_of
from vcmvsp.cosim.config import binding
from vcmvsp.cosim.errors import Interrupted, UsageError
from vcmvsp.cosim.kernel.kernel import Kernel, Observer
from vcmvsp.cosim.recording import external_inputs
from vcmvsp.cosim.runs.result import Result, figures_again
from vcmvsp.cosim.runs.simulation import Progress, Simulation
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.scenario import schema
from vcmvsp.cosim.util.files import Folder, writing
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.cosim.view.live.session import Viewing

Runs = schema.Runs

__all__ = ["Result", "Runs", "check", "plot", "run"]


def run(
    scenario: str | Path | Mapping[str, Any] | scenarios.Loaded,
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    agents: Mapping[str, Agent] | Runs | None = None,
    listen: str | None = None,
    keys: str | Path | None = None,
    insecure: bool = False,
    realtime: float | None = None,
    playback: str | Path | None = None,
    recorded_radio: str | Path | None = None,
    out: str | Path | None = None,
    numbered: bool = False,
    force: bool = False,
    mcap: bool = True,
    progress: Progress | None = None,
    tell: Tell = lambda _: None,
    observe: Observer | None = None,
    view: "Viewing | None" = None,
    watch: Callable[[], str | None] | None = None,
) -> Result:
    """Run a scenario to its end.

    Args:
        scenario: a built-in name, the path of a TOML file, its content as a mapping, or one that is loaded.
        seed: instead of the scenario's.
        set: key path -> value, e.g. ``{"radio.loss.probability": 0.3}``.
        agents: agents as objects, by vehicle; or where all agents run: ``"inprocess"``, ``"process"`` or ``"zenoh"``.
        listen: endpoint for hosts that are started by hand, instead of ``agents.listen``.
        keys: folder of certificates (``vcmvsp keys init``), for hosts on other machines.
        insecure: let hosts on other machines come without certificates.
        realtime: simulated seconds per wall-clock second, above 0; None: as fast as possible, or 1 with real vehicles.
        playback: folder of a run whose real vehicles do again what they did then; they are not driven.
        recorded_radio: ``radio.parquet`` of a run whose frames fare again as they did then, see `netsim.channel.replayed`.
        out: folder to write into; the recording then grows on disk while the run goes on.
        numbered: where ``out`` exists already, take ``out-2``, ``out-3``, ...: ``result.folder`` says which it was.
        force: write into a folder that is not empty.
        mcap: without it, nothing but tables and metrics is kept, in memory, which takes two thirds of the time.
        progress: called with (now, end) in ns before every instant.
        tell: takes lines for the user.
        observe: called with every event at its own time, behind the recording. What it does changes nothing of the run.
        view: shows the run while it goes on, and lets its user intervene (`cosim.view.live.session.Viewing`). The run then
            keeps to the wall clock, at speed 1 unless ``realtime`` says otherwise, until the user there changes it.
        watch: asked while hosts are waited for; an answer is why there is no use in it. None: the user starts them, told how.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
        FederateError: a part or an agent failed; ``error.result`` is the `Result` up to then.
        Interrupted: Ctrl-C; ``error.result`` likewise.
        UsageError: an argument is none of those, or there is a run in ``out`` already.
    """
    objects, runs = (None, agents) if agents is None or isinstance(agents, str) else (agents, None)
    if runs is not None and runs not in (*get_args(Runs), "encoded"):  # the last as `assemble` has it, for who tests the wire
        raise UsageError(f"agents: must be {binding.describe(Runs)}, not {runs!r}")
    folder = None if out is None else Folder(Path(out), force=force, numbered=numbered)
    if folder and not mcap:
        raise UsageError("mcap = False: what is written into a folder includes the MCAP file")
    loaded = scenario if isinstance(scenario, scenarios.Loaded) else scenarios.load(scenario, settings=set, seed=seed)
    parsed, source = loaded
    started, cpu = datetime.now(UTC), time.process_time()
    replayed = None if playback is None else external_inputs.read_inputs(Path(playback) / external_inputs.FILE, tell=tell)
    try:
        with assemble(
            parsed,
            source,
            clock=clock_of(parsed, realtime, replayed=replayed is not None),
            objects=objects,
            runs=runs,
            listen=listen,
            keys=None if keys is None else Path(keys),
            insecure=insecure,
            connect=replayed is None,
            playback=None if replayed is None else real_vehicles.playback(parsed, replayed, tell),
            bridged=replayed,
            recorded_radio=None if recorded_radio is None else Path(recorded_radio),
            tell=tell,
            watch=watch,
        ) as assembled:
            if playback is not None:
                assembled.keep(Path(playback) / external_inputs.FILE)  # so that a replay can be replayed
            simulation = Simulation(
                assembled, folder, mcap=mcap, progress=progress, tell=tell, observe=observe, view=view, speed=realtime
            )
            with writing(folder.path if folder else None), simulation.calm():
                failure = simulation.run()
                result = simulation.result(failure, started, time.process_time() - cpu)
    except KeyboardInterrupt:
        raise Interrupted("interrupted") from None
    if failure is not None:
        failure.result = result
        raise failure
    return result


def check(scenario: str | Path | Mapping[str, Any], *, set: Mapping[str, Any] | None = None) -> dict[str, Any]:  # noqa: A002
    """Build and start everything, run nothing, and give the resolved scenario.

    Agents are built in this process, wherever the scenario runs them.

    Raises:
        ScenarioError: the scenario cannot be run as it is.
    """
    parsed, source = scenarios.load(scenario, settings=set)
    with assemble(parsed, source, runs="here") as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        assembled.start(kernel)
        kernel.close()
        return assembled.resolved()


def plot(run_dir: Path, out: Path, *, svg: bool = False, tell: Tell = lambda _: None, trust: bool = False) -> list[Path]:
    """Draw the figures of a run that was saved, or cut, into the folder ``out``, as PNG or SVG; which files it wrote.

    With ``trust`` the class of its world is imported, if that is not built in.
    """
    from vcmvsp.cosim.plots import style

    figures = figures_again(run_dir, tell, trust=trust)
    with writing(out):
        out.mkdir(parents=True, exist_ok=True)
        save, kind = (style.save_svg, "svg") if svg else (style.save_png, "png")
        for name, figure in figures.items():
            save(figure, out / f"{name}.{kind}")
    return [out / f"{name}.{kind}" for name in figures]
