"""``vcmvsp robot``: the program on a robot's own computer."""

import importlib
import sys
from typing import Annotated

import typer

from vcmvsp.cosim.cli.options import DialInsecurely, KeysOfVehicle, pose_of

SERVE = "vcmvsp.hardware.remote_robot.robot_side.command_line"


def robot_command(
    vehicle: Annotated[str, typer.Option(metavar="NAME", help="Whose robot this is.")],
    driver: Annotated[
        str,
        typer.Option(
            metavar="KIND[:ADDRESS]", help="How it is driven from here: arcos:/dev/ttyUSB0, bench, my_robot.py:Rover, ..."
        ),
    ],
    connect: Annotated[
        str,
        typer.Option(
            metavar="ENDPOINT", help="Where the run waits for it (its driver's 'listen'), e.g. tls/192.168.1.10:7448."
        ),
    ],
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A parameter of the driver, e.g. robot=amigo.")
    ] = None,
    pose: Annotated[
        str | None, typer.Option(metavar="X,Y,YAW", help="Where it stands, m, m, rad [as the run supposes].")
    ] = None,
    keys: KeysOfVehicle = None,
    insecure: DialInsecurely = False,
) -> None:
    """Drive a robot from its own computer for runs elsewhere, whose driver of it is of the kind zenoh.

    It waits for runs and serves one after the other, until Ctrl-C. Without a velocity for 0.5 s, or without its run, the
    robot stands.

    Example: vcmvsp robot --vehicle car3 --driver arcos:/dev/ttyUSB0 --connect tls/192.168.1.10:7448 --keys car3.keys
    """
    from vcmvsp.cosim.scenario import loader as scenarios

    importlib.import_module(SERVE).robot(
        vehicle,
        driver,
        connect,
        params=scenarios.settings_of(set_ or []),
        keys=keys,
        insecure=insecure,
        pose=pose_of(pose),
        tell=lambda text: _say(f"{vehicle}: {text}"),
    )


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("robot")(robot_command)


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()
