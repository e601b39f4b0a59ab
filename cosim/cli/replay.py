"""``vcmvsp replay``: a recorded run again."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.cli.run import Force, Insecure, KeysOfRun, Listen, Quiet, Seed, Sets, WhereAgents, conduct

if TYPE_CHECKING:
    from vcmvsp.cosim.runs.api import Result


def replay_command(
    run_dir: Annotated[Path, typer.Argument(metavar="RUN_DIR", help="A folder that 'vcmvsp run' has left.")],
    seed: Seed = None,
    set_: Sets = None,
    agents: WhereAgents = None,
    twin: Annotated[bool, typer.Option("--twin", help="Simulate the vehicles that were real.")] = False,
    radio: Annotated[
        str, typer.Option(metavar="HOW", help="What becomes of frames: drawn anew, or recorded: as it was then.")
    ] = "drawn",
    listen: Listen = None,
    keys: KeysOfRun = None,
    insecure: Insecure = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder for the results [RUN_DIR-replay].")] = None,
    force: Force = False,
    json: AsJson = False,
    quiet: Quiet = False,
) -> None:
    """Run a recorded run again, changed or not: real vehicles do what they did then, algorithms run anew.

    Unchanged it gives the same numbers. Classes out of Python files are the copies that the run has kept in RUN_DIR.

    Example: vcmvsp replay runs/formation-circle-1 --set agents.estimator=hold
    """
    from vcmvsp.cosim.runs.replay import beside, replay

    def again(_: str, **options: Any) -> "Result":
        return replay(run_dir, **{**options, "numbered": out is None}, twin=twin, radio=radio)

    where: dict[str, Any] = {"agents": agents, "listen": listen, "keys": keys, "insecure": insecure}
    folder = beside(run_dir) if out is None else out
    conduct(
        again,
        str(run_dir / "scenario.toml"),
        set_ or [],
        folder,
        seed=seed,
        realtime=None,
        force=force,
        json=json,
        quiet=quiet,
        **where,
    )
