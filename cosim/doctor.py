"""``vcmvsp doctor``: says what works in this installation, and what does not."""

import platform
import sys
import time
from collections.abc import Callable

from cosim.errors import VcmvspError


def examine() -> int:
    """Print a line per check; 0 if all is well, else 1."""
    checks: list[tuple[str, Callable[[], str]]] = [
        ("python", _python),
        ("parts", _parts),
        ("pybullet", lambda: _version("physics.bullet", "pybullet")),
        ("zenoh", lambda: _version("cosim.transport.zenoh", "eclipse-zenoh")),
        ("run in one process", lambda: _run("inprocess")),
        ("run in four processes", lambda: _run("process")),
    ]
    worst = 0
    for name, check in checks:
        try:
            verdict, words = "ok", check()
        except (VcmvspError, ImportError, OSError) as error:
            verdict, words, worst = "FAILS", f"{error}", 1
        sys.stdout.write(f"{verdict:<6} {name}: {words}\n")
        sys.stdout.flush()
    return worst


def _python() -> str:
    return f"{platform.python_version()} at {sys.executable}"


def _parts() -> str:
    from cosim import registry

    registry.guard()
    return "all beside the core"


def _version(module: str, distribution: str) -> str:
    import importlib
    from importlib import metadata

    importlib.import_module(module)
    return metadata.version(distribution)


def _run(where: str) -> str:
    from cosim import api

    begin = time.monotonic()
    result = api.run("formation-circle", set={"duration_s": 5.0}, agents=where)  # type: ignore[arg-type]
    return f"digest {result.metrics['digest'][:12]} in {time.monotonic() - begin:.1f} s"
