"""``vcmvsp agent``, ``watch`` and ``doctor``: runs on other machines, and checks of installation and connection."""

import contextlib
import math
import platform
import sys
import time
from base64 import b64decode
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import typer

from vcmvsp.cosim.cli.options import AsJson, Changes, DialInsecurely, KeysOfVehicle, SecretOfRun, changes, say
from vcmvsp.cosim.cli.run import ViewHost, ViewPort, control_station
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.frames import yaw_of
from vcmvsp.cosim.util.text import plain, stdout_to_stderr
from vcmvsp.cosim.view import HOST, PORT

if TYPE_CHECKING:
    from vcmvsp.cosim.hosts.observers import Check, TopicValue
    from vcmvsp.cosim.security.certificates import Bundle


REFRESH_S = 0.5  # between two updates of a terminal
WIDTH = 100  # most characters of a value
Fields = Mapping[str, Any]
"""A value decoded from JSON."""


def agent_command(
    vehicle: Annotated[list[str], typer.Option(metavar="NAME", help="Vehicle whose agent to run; repeat for several.")],
    connect: Annotated[str, typer.Option(metavar="ENDPOINT", help="Where the run listens, e.g. tls/192.168.1.10:7447.")],
    kind: Annotated[
        str | None, typer.Argument(metavar="[MODULE_OR_FILE:Class]", help="Class of the agent [the scenario's].")
    ] = None,
    set_: Annotated[Changes, changes("A parameter of the agent, instead of the scenario's.")] = None,
    folder: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of Python files that the run may request by name.")
    ] = None,
    allow: Annotated[
        list[str] | None, typer.Option(metavar="CLASS", help="Another MODULE_OR_FILE:Class that the run may request.")
    ] = None,
    keys: KeysOfVehicle = None,
    insecure: DialInsecurely = False,
    secret: SecretOfRun = None,
) -> None:
    """Host agents for a run started with --agents zenoh.

    The host loads only built-in classes, classes named on this command line, and files in --folder.

    Example: vcmvsp agent my_agent.py:KeepGap --vehicle car2 --connect tls/192.168.1.10:7447 --keys car2.keys
    """
    from vcmvsp.cosim.assembly.parts.remote_programs import host_agents
    from vcmvsp.cosim.scenario import loader as scenarios

    why = host_agents(
        connect,
        tuple(vehicle),
        kind=kind,
        allow=allow or (),
        code_folder=folder,
        params=scenarios.settings_of(set_ or []),
        keys=keys,
        insecure=insecure,
        secret=secret,
        on_state=say,
    )
    say(why)


def watch_command(
    endpoint: Annotated[str, typer.Argument(metavar="ENDPOINT", help="Where the run listens, e.g. tls/192.168.1.10:7447.")],
    keys: Annotated[
        Path | None, typer.Option(metavar="FILE", help="This observer's certificate ('vcmvsp keys observer NAME').")
    ] = None,
    insecure: DialInsecurely = False,
    secret: SecretOfRun = None,
    topic: Annotated[
        list[str] | None, typer.Option(metavar="KEYEXPR", help="Topics, e.g. 'car2/*'; repeat for several [**].")
    ] = None,
    json: AsJson = False,
    count: Annotated[int | None, typer.Option(metavar="N", min=1, help="Stop after N lines.")] = None,
    view: Annotated[bool, typer.Option("--view", help="Show the run on a page of this machine, without controls.")] = False,
    view_host: ViewHost = HOST,
    view_port: ViewPort = PORT,
) -> None:
    """Watch a run from here, or from another machine, until it ends.

    A terminal shows the newest value of each topic twice per second; files, pipes and --json get all events. With --view a
    page on this machine shows the run; it cannot change the run.

    Example: vcmvsp watch tls/192.168.1.10:7447 --keys anna.keys --topic 'car2/*'
    """
    from vcmvsp.cosim.hosts.observers import watch
    from vcmvsp.cosim.transport import endpoints
    from vcmvsp.cosim.transport.endpoints import endpoint_rules

    if view and (topic or json or count is not None):
        raise UsageError("--view shows the whole run on a page: leave out --topic, --json and --count")

    bundle = _bundle(keys)
    if bundle is not None and (warning := bundle.check()):
        say(warning)
    endpoint = endpoint_rules(endpoint, bundle, insecure=insecure, side="observer")
    connection: dict[str, Any] = {"bundle": bundle, "secret": endpoints.secret_from(secret, insecure=insecure), "on_state": say}
    if view:
        _watch_page(endpoint, (view_host, view_port), connection)
        return
    newest_only = not json and sys.stdout.isatty()
    batches = watch(endpoint, topic or ["**"], every_s=REFRESH_S if newest_only else 0.0, **connection)
    remaining = sys.maxsize if count is None else count
    with contextlib.closing(batches):
        for batch in batches:
            events = (_newest(batch) if newest_only else batch)[:remaining]
            sys.stdout.writelines(map(_as_json if json else line, events))
            sys.stdout.flush()
            remaining -= len(events)
            if remaining == 0:
                break


def _watch_page(endpoint: str, page: tuple[str, int], connection: dict[str, Any]) -> None:
    from vcmvsp.cosim.view.live.broadcast import show

    with control_station(page) as station:
        show(endpoint, station, **connection)
        if sys.stderr.isatty():
            say("The page shows the end of the run until you press Ctrl-C.")
            station.stay()


def line(sample: "TopicValue") -> str:
    """An event as a line of text."""
    return plain(f"{sample.time_ns / 1e9:9.3f} s  {sample.topic:<16}  {words(sample.type, sample.value)}") + "\n"


def words(kind: str, value: object) -> str:
    """A value as text; JSON if its kind is unknown."""
    try:
        text = _WORDS[kind](value)
    except Exception:  # a kind of another version or of a user, with any content
        text = _json_or(value)
    return text if len(text) <= WIDTH else f"{text[: WIDTH - 3]}..."


def _json_or(value: object) -> str:
    try:
        return msgspec.json.encode(value).decode()
    except (ValueError, TypeError, OverflowError, RecursionError):
        return "(cannot be shown)"


def _newest(batch: Iterable["TopicValue"]) -> list["TopicValue"]:
    newest = {sample.topic: sample for sample in batch}
    return [newest[topic] for topic in sorted(newest)]


def _as_json(sample: "TopicValue") -> str:
    about = {"time_ns": sample.time_ns, "topic": sample.topic, "type": sample.type, "value": sample.value}
    return msgspec.json.encode(about).decode() + "\n"


def _vector(numbers: Sequence[float], unit: str) -> str:
    return f"({', '.join(map(_number, numbers))}) {unit}"


def _number(number: float) -> str:
    return f"{round(number, 2) + 0.0:.2f}"  # no -0.00


def _pairs(values: Fields) -> str:
    return "  ".join(f"{name} {_short(value)}" for name, value in values.items())


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else f"{value}"


def _state(value: Fields) -> str:
    yaw = yaw_of(tuple(value["attitude"]))
    return f"at {_vector(value['position'], 'm')}  yaw {_number(yaw)} rad  {math.hypot(*value['velocity']):.2f} m/s"


def _speed(velocity: Sequence[float]) -> str:
    forward, *others = velocity
    return _vector(velocity, "m/s") if any(others) else f"v {_number(forward)} m/s"


def _odometry(value: Fields) -> str:
    return f"pose {_vector(value['pose'], 'm, m, rad')}  v {_number(value['v'])} m/s  w {_number(value['w'])} rad/s"


def _waypoint(value: Fields) -> str:
    speed = "" if value["speed"] is None else f" at {value['speed']:.2f} m/s"
    return f"to {_vector(value['position'], 'm')}{speed}"


def _scan(value: Fields) -> str:
    ranges_m = [each for each in value["ranges"] if each is not None]
    return f"{len(value['ranges'])} beams, " + (f"the nearest {min(ranges_m):.2f} m" if ranges_m else "all free")


def _message(value: Fields) -> str:
    return f"{value['sender']} to {value['to'] or 'all'}, {value['size_bytes']} bytes: {_body(value['body'])}"


def _reception(value: Fields) -> str:
    took_ms = (value["received_ns"] - value["sent_ns"]) / 1e6
    message = value["message"]
    return f"from {message['sender']}, {value['rssi_dbm']:.1f} dBm, {took_ms:.2f} ms on the way: {_body(message['body'])}"


def _body(body: object) -> str:
    return _pairs(body) if isinstance(body, dict) else "bytes"


def _frame(value: Fields) -> str:
    fates = [f"{name} {outcome}" for name, outcome in zip(value["receivers"], value["outcome"], strict=True)]
    return f"of {value['sender']}, {value['size_bytes']} bytes: {', '.join(fates)}"


def _follows(value: Fields) -> str:
    return f"{value['leader']} at {_vector(value['slot'], 'm')}" if value["leader"] else "nobody"


def _looks(value: Fields) -> str:
    return f"at {len(value['cells'])} cells, {sum(value['hits'])} with a target"


def _map(value: Fields) -> str:
    probability, seen = (b64decode(value[name]) for name in ("probability", "seen"))
    sure = sum(each > 0.9 * 255 for each in probability)
    return f"{_sheet(value)}, {100 * sum(seen) / len(seen):.0f} % seen, {sure} with P > 0.9"


def _sightings(value: Fields) -> str:
    sightings = [f"{each['target']} {each['score']:.2f} at {_vector(each['place'], 'm')}" for each in value["found"]]
    return f"{value['sensor']}: {', '.join(sightings) or 'nothing'}"


def _sheet(value: Fields) -> str:
    return f"{value['columns']} x {value['rows']} cells of {value['cell_m']:g} m"


_WORDS: dict[str, Callable[[Any], str]] = {
    "state": _state,
    "states": lambda value: f"{len(value['names'])} vehicles",
    "velocity": lambda value: f"{_speed(value['linear'])}  w {_number(value['yaw_rate'])} rad/s",
    "waypoint": _waypoint,
    "odometry": _odometry,
    "fix": lambda value: f"at {_vector(value['position'], 'm')}",
    "imu": lambda value: f"{_vector(value['acceleration'], 'm/s2')}  {_vector(value['angular_velocity'], 'rad/s')}",
    "scan": _scan,
    "image": lambda value: f"{value['width']} x {value['height']} pixels",
    "measured": lambda value: _pairs(value["values"]),
    "looks": _looks,
    "map": _map,
    "sightings": _sightings,
    "mosaic": _sheet,
    "message": _message,
    "reception": _reception,
    "note": lambda value: _pairs(value["values"]),
    "follows": _follows,
    "presence": lambda value: f"its agent is {value['state']}" + (f": {value['why']}" if value["why"] else ""),
    "frame": _frame,
    "contact": lambda value: f"with {value['other'] or 'the world'}",
    "error": lambda value: str(value["message"]),
}


def doctor_command(
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Check the connection to a run at this endpoint instead.")
    ] = None,
    keys: Annotated[Path | None, typer.Option(metavar="FILE", help="This machine's certificate, for --connect.")] = None,
    insecure: DialInsecurely = False,
    secret: SecretOfRun = None,
    json: AsJson = False,
) -> None:
    """Check this installation with two short runs, or check the connection to a run on another machine.

    Example: vcmvsp doctor --connect tls/192.168.1.10:7447 --keys car2.keys
    """
    if connect is None and (keys is not None or insecure):
        raise UsageError("--keys and --insecure need a run to connect to: add --connect ENDPOINT")
    if connect is None and secret is not None:
        raise UsageError("--secret needs a run to connect to: add --connect ENDPOINT")
    checks = installation() if connect is None else connection(connect, keys, insecure=insecure, secret=secret)
    if json:
        with stdout_to_stderr():
            checks = iter(list(checks))
    raise SystemExit(report(checks, as_json=json))


def report(checks: "Iterable[Check]", *, as_json: bool = False) -> int:
    """Print a line per finished check; returns exit code 0 if all passed, else 1."""
    results = []
    for name, ok, words in checks:
        results.append({"name": name, "ok": ok, "words": words})
        if not as_json:
            sys.stdout.write(f"{'ok' if ok else 'FAILS':<6} {name}: {words}\n")
            sys.stdout.flush()
    if as_json:
        from vcmvsp.cosim.util.files import to_json

        sys.stdout.write(to_json(results))
    return int(not all(check["ok"] for check in results))


def installation() -> "Iterator[Check]":
    """Checks of the installation, and two short runs."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("python", _python),
        ("vcmvsp", _vcmvsp),
        _engine(),
        ("zenoh", lambda: _version("vcmvsp.cosim.transport.zenoh_session", "eclipse-zenoh")),
        ("run in one process", lambda: _run("inprocess")),
        ("run in four processes", lambda: _run("process")),
    ]
    for name, check in checks:
        try:
            yield name, True, check()
        except (VcmvspError, ImportError, OSError) as error:
            yield name, False, f"{error}"


def _engine() -> "tuple[str, Callable[[], str]]":
    """The check of the engine that moves bodies."""
    from vcmvsp.cosim.assembly.run import default_engine

    if default_engine() == "bullet":
        return "pybullet", lambda: _version("vcmvsp.physics.dynamics.bullet", "pybullet")
    return "mujoco", lambda: _version("vcmvsp.physics.dynamics.mujoco.engine", "mujoco-core")


def connection(
    endpoint: str, keys: Path | None = None, *, insecure: bool = False, secret: Path | None = None
) -> "Iterator[Check]":
    """Checks of the connection to the run at an endpoint with this certificate.

    Raises:
        UsageError: the endpoint is malformed or may not be dialled in this way, or the file is not a key bundle.
    """
    from vcmvsp.cosim.hosts.observers import examine
    from vcmvsp.cosim.transport import endpoints
    from vcmvsp.cosim.transport.endpoints import Side, endpoint_rules

    bundle = _bundle(keys)
    side: Side = "observer" if bundle and bundle.role == "observer" else "host"
    endpoint = endpoint_rules(endpoint, bundle, insecure=insecure, side=side)
    return examine(endpoint, bundle, endpoints.secret_from(secret, insecure=insecure))


def _bundle(keys: Path | None) -> "Bundle | None":
    if keys is None:
        return None
    from vcmvsp.cosim.security import certificates

    return certificates.load_bundle(keys)


def _python() -> str:
    return f"{platform.python_version()} at {sys.executable}"


def _vcmvsp() -> str:
    return f"{_version('vcmvsp.cosim', 'vcmvsp')} at {Path(__file__).resolve().parents[2]}"


def _version(module: str, distribution: str) -> str:
    import importlib

    from vcmvsp.cosim.util.versions import version_of

    importlib.import_module(module)
    return version_of(distribution)


def _run(where: str) -> str:
    from vcmvsp.cosim.runs import api

    begin = time.monotonic()
    result = api.run("formation-circle", set={"duration_s": 5.0}, agents=where)  # type: ignore[arg-type]
    return f"digest {result.metrics['digest'][:12]} in {time.monotonic() - begin:.1f} s"
