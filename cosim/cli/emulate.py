"""``vcmvsp emulate``: emulated devices at real ports, to rehearse runs with real robots."""

import os
import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vcmvsp.cosim.cli.options import PROGRAM, AsJson, Changes, changes, pose_of
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.util.text import stdout_to_stderr

if TYPE_CHECKING:
    from vcmvsp.cosim.assembly.parts.emulators import Ready, Tags

Port = Annotated[
    str,
    typer.Option(
        metavar="PORT",
        help="PTY (a pseudo-terminal), tcp://HOST:8101 (without HOST: for this machine alone), or a path for a link to a PTY.",
    ),
]
Pose = Annotated[str | None, typer.Option(metavar="X,Y,YAW", help="Start pose, m, m, rad [0,0,0, or the scenario's].")]
Seed = Annotated[int, typer.Option(metavar="N", min=0, help="Seed of faults and of positioning errors.")]
Duration = Annotated[float | None, typer.Option("--duration", metavar="S", help="Duration, s [until Ctrl-C].")]
TagName = Annotated[str, typer.Option("--tag", metavar="HEX", help="Number of the tag.")]
FixHz = Annotated[float, typer.Option("--fix-hz", metavar="HZ", help="Fixes a second.")]
SigmaM = Annotated[float, typer.Option("--sigma-m", metavar="M", help="Standard deviation of each coordinate of a fix.")]
Outliers = Annotated[float, typer.Option(metavar="P", help="Probability that a fix is 1 to 3 m off.")]
DropOuts = Annotated[float, typer.Option("--drop-outs", metavar="P", help="Probability that a fix is missing.")]
FixLatency = Annotated[float, typer.Option("--fix-latency-s", metavar="S", help="Time from measurement to output of a fix, s.")]
Circle = Annotated[
    str | None, typer.Option(metavar="R,SPEED", help="Drive a circle to the left, m, m/s; R < 0: to the right [at rest].")
]

emulate_app = typer.Typer(
    name="emulate",
    help="Software emulations of robots, autopilots and positioning tags at a real port.\n\n"
    "The first line on stdout is the address to connect to. Ctrl-C ends it.\n\nStart with: vcmvsp emulate amigobot",
    no_args_is_help=True,
    rich_markup_mode=None,
)


def robot_command(
    context: typer.Context,
    port: Port = "PTY",
    pose: Pose = None,
    rate_hz: Annotated[float, typer.Option(metavar="HZ", help="Information packets per second.")] = 10.0,
    faults: Annotated[
        str, typer.Option(metavar="NAME=P,...", help="Faults per byte on the line: drop=0.01,flip=0.001,split=0.2,gap_ms=30.")
    ] = "",
    paced: Annotated[bool, typer.Option("--paced", help="Transfer bytes at the baud rate.")] = False,
    baud: Annotated[int, typer.Option(metavar="N", help="Baud rate, until the client sets another one.")] = 9600,
    ping_ms: Annotated[int, typer.Option(metavar="T", help="Time between pings of an array of 8 sonars, ms.")] = 40,
    no_watchdog: Annotated[bool, typer.Option("--no-watchdog", help="Do not stop after 2 s without a command.")] = False,
    ubisense: Annotated[
        str | None, typer.Option(metavar="udp://HOST:PORT", help="Add a positioning tag that sends Ubisense datagrams there.")
    ] = None,
    dwm1001: Annotated[str | None, typer.Option(metavar="PTY|PATH", help="Add a DWM1001 tag with this serial port.")] = None,
    tag: TagName = "1",
    fix_hz: FixHz = 5.0,
    sigma_m: SigmaM = 0.15,
    outliers: Outliers = 0.0,
    drop_outs: DropOuts = 0.0,
    fix_latency_s: FixLatency = 0.0,
    scenario: Annotated[
        str | None, typer.Option(metavar="SCENARIO", help="Drive in its world with its other vehicles, in real time.")
    ] = None,
    vehicle: Annotated[str | None, typer.Option(metavar="NAME", help="Vehicle of the scenario.")] = None,
    set_: Annotated[Changes, changes("Change a key of the scenario.")] = None,
    seed: Seed = 0,
    duration: Duration = None,
    json: AsJson = False,
) -> None:
    """Emulate a robot with ARCOS at a serial port or over TCP.

    In a scenario with physics.kind = "kinematic" it senses walls, but does not collide.

    Example: vcmvsp emulate p2dx --port tcp://:8101 --scenario lab-patrol --vehicle ugv1 --ubisense udp://127.0.0.1:5000
    """
    from vcmvsp.cosim.assembly.parts import emulators
    from vcmvsp.cosim.runs.api import run
    from vcmvsp.cosim.scenario import loader as scenarios

    if scenario is None and (vehicle is not None or set_):
        raise UsageError("--vehicle and --set need a scenario: add --scenario")
    errors = {"fix_hz": fix_hz, "sigma_m": sigma_m, "outliers": outliers, "drop_outs": drop_outs, "latency_s": fix_latency_s}
    tags = emulators.tags_of(ubisense=ubisense, dwm1001=dwm1001, tag=tag, seed=seed, option=None, **errors)
    options = emulators.RobotOptions(
        port=emulators.port_of(port),
        rate_hz=rate_hz,
        faults=emulators.faults_of(faults, seed),
        paced=paced,
        baud=baud,
        ping_ms=ping_ms,
        watchdog=not no_watchdog,
        duration_s=emulators.duration_of(duration),
        tags=tags,
    )
    start = pose_of(pose)
    name = str(context.info_name)
    if scenario is None:
        _show(lambda ready: emulators.emulate_robot(name, options, ready, start), as_json=json, driver="arcos")
        return
    settings = scenarios.settings_of(set_ or [])
    _show(
        lambda ready: emulators.emulate_vehicle(
            name, options, ready, start, run=run, scenario_name=scenario, vehicle=vehicle, settings=settings
        ),
        as_json=json,
        driver="arcos",
    )


for _name in ("amigobot", "p2dx", "amigo-sh"):
    emulate_app.command(_name, short_help="A robot with ARCOS, serial or TCP", epilog=PROGRAM)(robot_command)


@emulate_app.command("ubisense", short_help="A Ubisense positioning system over UDP")
def ubisense_command(
    port: Annotated[str, typer.Option(metavar="udp://HOST:PORT", help="Destination of the datagrams.")],
    pose: Pose = None,
    circle: Circle = None,
    tag: TagName = "1",
    fix_hz: FixHz = 5.0,
    sigma_m: SigmaM = 0.15,
    outliers: Outliers = 0.0,
    drop_outs: DropOuts = 0.0,
    fix_latency_s: FixLatency = 0.0,
    seed: Seed = 0,
    duration: Duration = None,
    json: AsJson = False,
) -> None:
    """Emulate a tag of a Ubisense system, which sends its position in UDP datagrams.

    Example: vcmvsp emulate ubisense --port udp://127.0.0.1:5000 --circle 2,0.3
    """
    from vcmvsp.cosim.assembly.parts.emulators import tags_of

    errors = {"fix_hz": fix_hz, "sigma_m": sigma_m, "outliers": outliers, "drop_outs": drop_outs, "latency_s": fix_latency_s}
    tags = tags_of(ubisense=port, dwm1001=None, tag=tag, seed=seed, option="--port", **errors)
    _show_tag(tags, pose, circle, duration, as_json=json)


@emulate_app.command("dwm1001", short_help="A DWM1001 positioning tag at a serial port")
def dwm1001_command(
    port: Annotated[str, typer.Option(metavar="PTY|PATH", help="A pseudo-terminal, or a path for a link to one.")] = "PTY",
    pose: Pose = None,
    circle: Circle = None,
    tag: TagName = "1",
    fix_hz: FixHz = 10.0,
    sigma_m: SigmaM = 0.15,
    outliers: Outliers = 0.0,
    drop_outs: DropOuts = 0.0,
    fix_latency_s: FixLatency = 0.0,
    seed: Seed = 0,
    duration: Duration = None,
    json: AsJson = False,
) -> None:
    """Emulate a DWM1001 tag at a serial port: two carriage returns open its shell, lep starts the output of positions.

    Example: vcmvsp emulate dwm1001 --port /tmp/tag --pose 1,2,0
    """
    from vcmvsp.cosim.assembly.parts.emulators import tags_of

    errors = {"fix_hz": fix_hz, "sigma_m": sigma_m, "outliers": outliers, "drop_outs": drop_outs, "latency_s": fix_latency_s}
    tags = tags_of(ubisense=None, dwm1001=port, tag=tag, seed=seed, option="--port", **errors)
    _show_tag(tags, pose, circle, duration, as_json=json)


@emulate_app.command("mavlink", short_help="A vehicle with MAVLink over UDP or TCP")
def mavlink_command(
    port: Annotated[
        str, typer.Option(metavar="PORT", help="udp://HOST:PORT (it sends there) or tcp://HOST:PORT (it listens there).")
    ] = "udp://127.0.0.1:14540",
    autopilot: Annotated[str, typer.Option(metavar="px4|ardupilot", help="Autopilot that it emulates.")] = "px4",
    kind: Annotated[str, typer.Option(metavar="quadrotor|rover", help="Type of vehicle.")] = "quadrotor",
    system_id: Annotated[int, typer.Option("--system-id", metavar="N", help="Its number.")] = 1,
    armed: Annotated[bool, typer.Option("--armed", help="Start with armed motors.")] = False,
    pose: Pose = None,
    duration: Duration = None,
    json: AsJson = False,
) -> None:
    """Emulate a vehicle with a MAVLink autopilot, over UDP or TCP.

    Example: vcmvsp emulate mavlink --port tcp://:5760 --autopilot ardupilot --kind rover
    """
    from vcmvsp.cosim.assembly.parts.mavlink_emulator import emulate

    start = pose_of(pose)
    _show(
        lambda ready: emulate(
            port, ready, autopilot=autopilot, kind=kind, system_id=system_id, armed=armed, pose=start, duration_s=duration
        ),
        as_json=json,
    )


@emulate_app.command("ros2", short_help="A robot with ROS 2 over rmw_zenoh")
def ros2_command(
    port: Annotated[str, typer.Option(metavar="tcp/HOST:PORT", help="Zenoh endpoint that it listens on.")] = (
        "tcp/127.0.0.1:7447"
    ),
    stamped: Annotated[bool, typer.Option("--stamped", help="Subscribe to TwistStamped instead of Twist.")] = False,
    pose: Pose = None,
    duration: Duration = None,
    json: AsJson = False,
) -> None:
    """Emulate a robot with ROS 2 over rmw_zenoh: it subscribes to cmd_vel and publishes odom.

    Example: vcmvsp emulate ros2 --pose 1,2,0
    """
    from vcmvsp.cosim.assembly.parts.ros2_emulator import emulate

    start = pose_of(pose)
    _show(lambda ready: emulate(port, ready, stamped=stamped, pose=start, duration_s=duration), as_json=json)


def _show_tag(tags: "Tags", pose: str | None, circle: str | None, duration_s: float | None, *, as_json: bool) -> None:
    from vcmvsp.cosim.assembly.parts.emulators import circle_of, duration_of, emulate_tag

    start = pose_of(pose) or (0.0, 0.0, 0.0)
    way = None if circle is None else circle_of(circle)
    _show(lambda ready: emulate_tag(tags, ready, pose=start, circle=way, duration_s=duration_of(duration_s)), as_json=as_json)


def _show(emulate: "Callable[[Ready], Mapping[str, Any]]", *, as_json: bool, driver: str = "") -> None:
    """Run an emulator; prints its addresses when it is ready and its counters at the end.

    Args:
        driver: kind of the driver of the robot, for whose scenario lines are printed; empty: there is no robot.
    """
    import json

    out = _own_stdout()

    def say(about: Mapping[str, Any]) -> None:
        if as_json:
            out(json.dumps(about) + "\n")
            return
        out("".join(f"{url}\n" for url in _urls(about)))
        if driver:
            sys.stderr.writelines(f"{line}\n" for line in _of_scenario(driver, about))

    with stdout_to_stderr():
        happened = emulate(say)
        out(json.dumps(happened) + "\n" if as_json else _words(happened))


def _of_scenario(driver: str, about: Mapping[str, Any]) -> list[str]:
    """Lines for the scenario that drives this robot."""
    positioning = about["positioning"]
    places = {"ubisense": ("listen", positioning.get("ubisense")), "dwm1001": ("port", positioning.get("dwm1001"))}
    tables = [f'{{ kind = "{kind}", {key} = "{url}" }}' for kind, (key, url) in places.items() if url]
    where = tables[0] if tables else '{ kind = "none" }  # by odometry; or add --ubisense udp://127.0.0.1:5010'
    return [
        "lines for its [[vehicle]] in the scenario:",
        f'  driver = {{ kind = "{driver}", port = "{about["url"]}" }}',
        f"  localisation = {where}",
    ]


def _urls(about: Mapping[str, Any]) -> list[str]:
    """Addresses to connect to, the robot's first; the target of datagrams only if there is no other."""
    ports = [each for each in (about.get("url"), about["positioning"].get("dwm1001")) if each]
    return ports or list(about["positioning"].values())


def _words(happened: Mapping[str, Any]) -> str:
    lines = []
    if "commands" in happened:
        lines.append(f"{happened['commands']} commands received, {happened['packets']} information packets sent")
        lines.append(
            f"{happened['bytes_lost']} bytes lost and {happened['bytes_changed']} changed on the line, "
            f"{happened['bytes_unread']} not read"
        )
        lines.append(f"position by its wheels: x {happened['x_m']:.2f} m, y {happened['y_m']:.2f} m")
    if (lateness := happened.get("lateness")) and lateness["over_one_period"]:
        lines.append(f"the simulation was late {lateness['over_one_period']} times, by {lateness['max_s']:.2f} s at most")
    if "messages" in happened:
        lines.append(f"{happened['messages']} messages heard")
        lines.append(f"position: x {happened['x_m']:.2f} m, y {happened['y_m']:.2f} m, z {happened.get('z_m', 0.0):.2f} m")
    if "mode" in happened:
        lines.append(f"it is {'' if happened['armed'] else 'not '}armed, in {happened['mode']}")
    lines += [f"{count} fixes of {name}" for name, count in happened["fixes"].items()]
    return "".join(f"{line}\n" for line in lines)


def _own_stdout() -> Callable[[str], None]:
    """A writer to the present standard output, which stays valid when standard output is redirected."""
    stdout = sys.stdout

    def write(text: str) -> None:
        stdout.write(text)
        stdout.flush()

    try:
        saved = os.dup(stdout.fileno())
    except (OSError, ValueError, AttributeError):  # standard output is not a file, as in a notebook
        return write
    return lambda text: _write(saved, text.encode())


def _write(file: int, data: bytes) -> None:
    while data:
        data = data[os.write(file, data) :]
