"""``vcmvsp study``: a scenario at every point of a grid."""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.cli.run import simulated
from vcmvsp.cosim.errors import UsageError, VcmvspError

SHOWN = 40  # points


def study_command(
    scenario: Annotated[str, typer.Argument(metavar="SCENARIO", help="A name that 'vcmvsp list' shows, or a .toml file.")],
    vary: Annotated[
        list[str] | None,
        typer.Option(
            metavar="KEY=VALUES", help="KEY=a,b,c or KEY=start:stop:step; repeat for a grid [the scenario's [study] table]."
        ),
    ] = None,
    seeds: Annotated[int | None, typer.Option(metavar="N", help="Runs of each point of the grid [20].")] = None,
    metric: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="What is drawn and summarised, e.g. formation.rms_m; repeat for several."),
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a key of the scenario for all runs.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="The first seed, instead of the scenario's.")] = None,
    jobs: Annotated[int | None, typer.Option(metavar="N", help="Runs at once [as many as there are cores].")] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="Run on the workers of this Dask scheduler, e.g. tcp://10.0.0.1:8786.")
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results [runs/NAME-study].")] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the study in DIR; values and seeds may be added.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Write into DIR even if it is not empty.")] = False,
    twin: Annotated[bool, typer.Option("--twin", help="Simulate the scenario's real vehicles.")] = False,
    json: AsJson = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing unless something goes wrong.")] = False,
) -> None:
    """Run a scenario over a grid of values, with the same seeds at each point.

    Example: vcmvsp study formation-slalom --vary radio.loss.probability=0:0.8:0.2 --vary agents.estimator=hold,dr --seeds 5
    """
    from vcmvsp.cosim.scenario import loader as scenarios
    from vcmvsp.cosim.studies import engine, grid
    from vcmvsp.cosim.studies.summary import rows, summarise
    from vcmvsp.cosim.terminal.progress import StudyProgress
    from vcmvsp.cosim.util.files import to_json
    from vcmvsp.cosim.util.text import stdout_to_stderr

    if out is not None and str(out) == ".":
        raise UsageError("--out: name a folder; the current one is not a good place for the files of a study")
    settings = scenarios.settings_of(simulated(scenario, set_ or []) if twin else set_ or [])
    with stdout_to_stderr(), StudyProgress(quiet=quiet) as progress:
        studied = engine.conduct(
            scenario,
            vary=grid.vary_of(vary or []),
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
        )
    plan, table = studied.plan, studied.table
    summary = summarise(table, list(plan.vary), plan.metrics)
    failed = [text for text in table["error"].to_pylist() if text is not None]
    points = rows(summary, list(plan.vary), plan.metrics)
    if json:
        about = {"scenario": plan.scenario, "vary": plan.vary, "seeds": plan.seeds, "runs": plan.size, "failed": len(failed)}
        sys.stdout.write(to_json({**about, "rows": points, "out": str(studied.folder)}))
    elif not quiet:
        sys.stdout.write(f"{plan.scenario}: {plan.size} runs, {len(points)} points with {len(plan.seeds)} seeds each\n")
        sys.stdout.write(_table(points, list(plan.vary), plan.metrics))
        sys.stdout.write(f"results: {studied.folder}\n")
    if failed:
        which = "every run" if len(failed) == plan.size else f"{len(failed)} of {plan.size} runs"
        raise VcmvspError(f"{which} failed, the first with: {failed[0]}")


def _table(points: Sequence[Mapping[str, Any]], keys: Sequence[str], metrics: Sequence[str]) -> str:
    """Mean and band of each metric at each point, in columns."""
    lines = [[*keys, "n", *metrics]]
    lines += [
        [*(str(point[key]) for key in keys), str(point["n"]), *(_band(point[name]) for name in metrics)]
        for point in points[:SHOWN]
    ]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = "".join("  ".join(map(str.ljust, line, widths)).rstrip() + "\n" for line in lines)
    return text + (f"... and {len(points) - SHOWN} more points, in summary.csv\n" if len(points) > SHOWN else "")


def _band(found: Mapping[str, float | None]) -> str:
    if found["mean"] is None:
        return "-"
    band = "" if found["low"] is None else f" [{found['low']:.4g}, {found['high']:.4g}]"
    return f"{found['mean']:.4g}{band}"
