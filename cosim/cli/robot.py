"""``vcmvsp robot``, ``stop`` and ``operator``: drive robots from this machine, and stop them."""

import contextlib
import json as jsons
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from vcmvsp.cosim.cli.options import AsJson, Changes, DialInsecurely, KeysOfVehicle, changes, pose_of, say

if TYPE_CHECKING:
    from vcmvsp.cosim.assembly.parts.stations import StationAnswer

NOBODY = "you drive no robot on this machine"


def robot_command(
    vehicle: Annotated[str, typer.Option(metavar="NAME", help="Vehicle that this robot is.")],
    driver: Annotated[
        str,
        typer.Option(
            metavar="KIND[:ADDRESS]", help="Driver on this computer: arcos:/dev/ttyUSB0, bench, my_robot.py:Rover, ..."
        ),
    ],
    connect: Annotated[
        str,
        typer.Option(metavar="ENDPOINT", help="Endpoint of the run (the 'listen' of its driver), e.g. tls/192.168.1.10:7448."),
    ],
    set_: Annotated[Changes, changes("A parameter of the driver, e.g. robot=amigo.")] = None,
    pose: Annotated[
        str | None, typer.Option(metavar="X,Y,YAW", help="Pose of the robot, m, m, rad [the start pose of the run].")
    ] = None,
    keys: KeysOfVehicle = None,
    insecure: DialInsecurely = False,
) -> None:
    """Drive a robot from its own computer, for runs elsewhere with a driver of kind zenoh.

    It serves one run after the other, until Ctrl-C. Without a velocity for 0.5 s, or without a run, the robot stops.

    Example: vcmvsp robot --vehicle car3 --driver arcos:/dev/ttyUSB0 --connect tls/192.168.1.10:7448 --keys car3.keys
    """
    from vcmvsp.cosim.assembly.parts.remote_programs import serve_robot
    from vcmvsp.cosim.scenario import loader as scenarios

    serve_robot(
        vehicle,
        driver,
        connect,
        params=scenarios.settings_of(set_ or []),
        keys=keys,
        insecure=insecure,
        pose=pose_of(pose),
        tell=lambda text: say(f"{vehicle}: {text}"),
    )


def stop_command(
    vehicle: Annotated[list[str] | None, typer.Argument(metavar="[VEHICLE]...", help="Vehicles [all].")] = None,
    json: AsJson = False,
) -> None:
    """Stop all robots that you drive on this machine, or the given ones, until their run ends.

    Works also if the run hangs. Exit code 1: there was no robot, or one did not answer.

    Example: vcmvsp stop
    """
    answers, missing = stopped(vehicle or [])
    if json:
        sys.stdout.write(f"{jsons.dumps(msgspec.to_builtins(answers))}\n")
    else:
        sys.stdout.writelines(map(line, answers))
    if missing:
        sys.stderr.write(f"vcmvsp: {NOBODY}" + (f" as {', '.join(missing)}\n" if vehicle else "\n"))
    if missing or any(each.state == "silent" for each in answers):
        raise SystemExit(1)


def operator_command(
    rate_hz: Annotated[float, typer.Option(metavar="HZ", min=1, max=100, help="Rate of messages to the robots.")] = 10.0,
) -> None:
    """Enable robots with safety.operator_s, which drive only while this command runs; Ctrl-C stops them.

    Example: vcmvsp operator
    """
    from vcmvsp.cosim.assembly.parts.stations import StopCaller

    sys.stdout.write("robots drive while this runs; Ctrl-C stops them\n")
    with contextlib.suppress(KeyboardInterrupt), StopCaller() as caller:
        printed, due = None, time.monotonic()
        while True:
            vehicles = sorted(each.vehicle for each in caller.say("alive"))
            if vehicles != printed:
                sys.stdout.write(f"{', '.join(vehicles) or NOBODY}\n")
                sys.stdout.flush()
                printed = vehicles
            due = max(due + 1.0 / rate_hz, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    answers, _ = stopped([])
    sys.stdout.writelines(map(line, answers))
    if any(each.state == "silent" for each in answers):
        raise SystemExit(1)


def stopped(vehicles: Sequence[str]) -> "tuple[list[StationAnswer], list[str]]":
    """Stop these robots (none named: all); returns the answers, and the names without a robot."""
    from vcmvsp.cosim.assembly.parts.stations import LONGEST_NAME, StopCaller

    with StopCaller() as caller:
        stations = caller.say("stop", vehicles)
        answers = caller.answers(stations)
    with_station = {each.vehicle for each in stations}
    missing = [each for each in vehicles if each[:LONGEST_NAME] not in with_station]
    return answers, missing if vehicles or stations else ["any"]


def line(answer: "StationAnswer") -> str:
    """A station's answer as a line of text."""
    match answer.state:
        case "silent":
            return f"{answer.vehicle}: DOES NOT ANSWER (process {answer.pid}): stop the robot by hand\n"
        case "ended":
            return f"{answer.vehicle}: no longer driven\n"
    return f"{answer.vehicle}: {answer.state} (run {answer.run})\n"
