"""``vcmvsp stop`` and ``vcmvsp operator``: stop the robots that are driven on this machine, whatever their runs do."""

import contextlib
import json as jsons
import sys
import time
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from vcmvsp.cosim.cli.options import AsJson
from vcmvsp.cosim.config import registry

NOBODY = "no robot is driven on this machine by you"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command("stop")(stop_command)
    app.command("operator")(operator_command)


def stop_command(
    vehicle: Annotated[list[str] | None, typer.Argument(metavar="[VEHICLE]...", help="Which ones [all].")] = None,
    json: AsJson = False,
) -> None:
    """Stop all robots that you drive on this machine, or these; they stand until their run ends.

    Works while the run hangs, too. Exit code 1: there was none, or one did not answer.

    Example: vcmvsp stop
    """
    answers, missing = stopped(vehicle or [])
    if json:
        sys.stdout.write(f"{jsons.dumps([_told(each) for each in answers])}\n")
    else:
        sys.stdout.writelines(map(line, answers))
    if missing:
        sys.stderr.write(f"vcmvsp: {NOBODY}" + (f" as {', '.join(missing)}\n" if vehicle else "\n"))
    if missing or any(each.state == "silent" for each in answers):
        raise SystemExit(1)


def operator_command(
    rate_hz: Annotated[float, typer.Option(metavar="HZ", min=1, max=100, help="How often robots are told.")] = 10.0,
) -> None:
    """Be the operator: robots with safety.operator_s drive only while this runs; Ctrl-C stops all.

    Example: vcmvsp operator
    """
    stations = registry.piece("stations")
    sys.stdout.write("robots drive while this runs; Ctrl-C stops them\n")
    with contextlib.suppress(KeyboardInterrupt), stations.Caller() as caller:
        shown, due = None, time.monotonic()
        while True:
            there = sorted(each.vehicle for each in caller.say("alive"))
            if there != shown:
                sys.stdout.write(f"{', '.join(there) or NOBODY}\n")
                sys.stdout.flush()
                shown = there
            due = max(due + 1.0 / rate_hz, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))
    answers, _ = stopped([])
    sys.stdout.writelines(map(line, answers))
    if any(each.state == "silent" for each in answers):
        raise SystemExit(1)


def stopped(vehicles: Sequence[str]) -> tuple[list[Any], list[str]]:
    """Stop them (none named: all); what each answered, and what there was none of."""
    stations = registry.piece("stations")
    with stations.Caller() as caller:
        asked = caller.say("stop", vehicles)
        answers = caller.answers(asked)
    there = {each.vehicle for each in asked}
    missing = [each for each in vehicles if each[: stations.LONGEST_NAME] not in there]
    return answers, missing if vehicles or asked else ["any"]


def line(answer: Any) -> str:
    """What a station said, for people."""
    match answer.state:
        case "silent":
            return f"{answer.vehicle}: DOES NOT ANSWER (process {answer.pid}): look after the robot\n"
        case "ended":
            return f"{answer.vehicle}: not driven any more\n"
    return f"{answer.vehicle}: {answer.state} (run {answer.run})\n"


def _told(answer: Any) -> dict[str, Any]:
    return {name: getattr(answer, name) for name in answer.__struct_fields__}
