"""``vcmvsp launch``: a run, and its hosts on other machines."""

import functools
from pathlib import Path
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.cli.run import (
    Force,
    Insecure,
    KeysOfRun,
    Listen,
    Out,
    Quiet,
    Realtime,
    ScenarioName,
    Seed,
    Sets,
    conduct,
)


def launch_command(
    scenario: ScenarioName,
    hosts: Annotated[Path, typer.Option(metavar="FILE", help="Which machines host which vehicles' agents, e.g. hosts.toml.")],
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

    What they say is shown, and kept in DIR/hosts. They end with the run, however it ends.

    Example: vcmvsp launch formation-circle --hosts hosts.toml --listen tls/0.0.0.0:7447 --keys keys
    """
    from vcmvsp.cosim.runs.launch import launch

    run = functools.partial(launch, hosts=hosts)
    where: dict[str, Any] = {"listen": listen, "keys": keys, "insecure": insecure}
    conduct(run, scenario, set_ or [], out, seed=seed, realtime=realtime, force=force, json=json, quiet=quiet, **where)
