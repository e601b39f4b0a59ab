"""``vcmvsp doctor``: says what works in this installation, or on the way from here to a run, and what does not."""

import platform
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vcmvsp.cosim.cli.options import AsJson, DialInsecurely, SecretOfRun
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.util.text import stdout_to_stderr

if TYPE_CHECKING:
    from vcmvsp.cosim.hosts.observers.reachability import Check


def doctor_command(
    connect: Annotated[
        str | None, typer.Option(metavar="ENDPOINT", help="Check the way to a run that listens there, instead.")
    ] = None,
    keys: Annotated[Path | None, typer.Option(metavar="FILE", help="This machine's certificate, for --connect.")] = None,
    insecure: DialInsecurely = False,
    secret: SecretOfRun = None,
    json: AsJson = False,
) -> None:
    """Check this installation and make two short runs, or check the way to a run on another machine.

    Example: vcmvsp doctor --connect tls/192.168.1.10:7447 --keys car2.keys
    """
    if connect is None and (keys is not None or insecure):
        raise UsageError("--keys and --insecure say how to reach a run: add --connect ENDPOINT")
    checks = installation() if connect is None else connection(connect, keys, insecure=insecure, secret=secret)
    if json:
        with stdout_to_stderr():
            checks = iter(list(checks))
    raise SystemExit(report(checks, as_json=json))


def report(checks: "Iterable[Check]", *, as_json: bool = False) -> int:
    """Print a line per check as soon as it is known; 0 if all is well, else 1."""
    found = []
    for name, ok, words in checks:
        found.append({"name": name, "ok": ok, "words": words})
        if not as_json:
            sys.stdout.write(f"{'ok' if ok else 'FAILS':<6} {name}: {words}\n")
            sys.stdout.flush()
    if as_json:
        from vcmvsp.cosim.util.files import to_json

        sys.stdout.write(to_json(found))
    return 0 if all(check["ok"] for check in found) else 1


def installation() -> "Iterator[Check]":
    """Whether everything is here, and two short runs."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("python", _python),
        ("vcmvsp", _vcmvsp),
        ("pybullet", lambda: _version("vcmvsp.physics.dynamics.bullet", "pybullet")),
        ("zenoh", lambda: _version("vcmvsp.cosim.transport.zenoh_session", "eclipse-zenoh")),
        ("run in one process", lambda: _run("inprocess")),
        ("run in four processes", lambda: _run("process")),
    ]
    for name, check in checks:
        try:
            yield name, True, check()
        except (VcmvspError, ImportError, OSError) as error:
            yield name, False, f"{error}"


def connection(
    endpoint: str, keys: Path | None = None, *, insecure: bool = False, secret: Path | None = None
) -> "Iterator[Check]":
    """How well the run at an endpoint can be reached with this certificate.

    Raises:
        UsageError: the endpoint is none, or may not be dialled so, or the file is none of a machine.
    """
    from vcmvsp.cosim.hosts.observers.reachability import examine
    from vcmvsp.cosim.transport import local_secret
    from vcmvsp.cosim.transport.endpoints import Side, endpoint_rules

    bundle = None
    if keys is not None:
        from vcmvsp.cosim.security import certificates

        bundle = certificates.load_bundle(keys)
    side: Side = "observer" if bundle and bundle.role == "observer" else "host"
    endpoint = endpoint_rules(endpoint, bundle, insecure=insecure, side=side)
    return examine(endpoint, bundle, local_secret.given(secret, insecure=insecure))


def _python() -> str:
    return f"{platform.python_version()} at {sys.executable}"


def _vcmvsp() -> str:
    return f"{_version('vcmvsp.cosim', 'vcmvsp')} at {Path(__file__).resolve().parents[2]}"


def _version(module: str, distribution: str) -> str:
    import importlib
    from importlib import metadata

    importlib.import_module(module)
    return metadata.version(distribution)


def _run(where: str) -> str:
    from vcmvsp.cosim.runs import api

    begin = time.monotonic()
    result = api.run("formation-circle", set={"duration_s": 5.0}, agents=where)  # type: ignore[arg-type]
    return f"digest {result.metrics['digest'][:12]} in {time.monotonic() - begin:.1f} s"
