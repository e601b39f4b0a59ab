"""A process that hosts agents: started by a run (``runs = "process"``) or by a user (``vcmvsp agent``)."""

import argparse
import io
import os
import re
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from threadpoolctl import threadpool_limits

from vcmvsp.agents.factory import check_acts
from vcmvsp.agents.federate import AgentHost
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.hosts.host_client import Desk, serve
from vcmvsp.cosim.hosts.protocol import PROTOCOL, Hello
from vcmvsp.cosim.scenario.schema import AgentTable
from vcmvsp.cosim.transport import endpoints
from vcmvsp.cosim.transport.endpoints import endpoint_rules

GRACE_S = 0.2


def host(
    endpoint: str,
    vehicles: tuple[str, ...],
    *,
    kind: str | None = None,
    allow: Iterable[str] = (),
    code_folder: Path | None = None,
    params: dict[str, Any] | None = None,
    token: str = "",
    keys: Path | None = None,
    insecure: bool = False,
    secret: Path | None = None,
    on_state: Callable[[str], None] = lambda _: None,
) -> str:
    """Serve the agents of vehicles to the run at ``endpoint`` until it ends; returns the reason of the end.

    Args:
        endpoint: Zenoh endpoint of the run, e.g. ``tcp/127.0.0.1:7447``.
        vehicles: names of the vehicles.
        kind: class of the agents, a file relative to the current folder; None: the kind of the scenario.
        allow: other classes that the run may load, as modules or files.
        code_folder: folder of Python files that the run may load by name; None: none.
        params: parameters that override the scenario's.
        token: proof that the run started this host.
        keys: file with the certificate of this machine.
        insecure: work without a certificate even if the run is on another machine or of another user.
        secret: file with the secret of a run without certificates (`cosim.transport.endpoints`); None: the user's own.
        on_state: receives texts about the current state.
    """
    for vehicle in vehicles:
        if not re.fullmatch(r"[A-Za-z0-9_-]+", vehicle):
            raise UsageError(f"--vehicle {vehicle!r}: a name has only letters, digits, _ and -")
    if reserved := [name for name in params or {} if name in binding.parameters(AgentTable)]:
        raise UsageError(f"--set {reserved[0]}: a key of the scenario; a host sets only parameters of its agent")
    class_names = registry.classes_in([*allow, kind, params])
    may_load = registry.only(None if token else registry.OwnCode(class_names, code_folder, on_state))
    if kind is not None:  # errors of the class are reported here: the run continues to wait
        with registry.only(registry.OwnCode(class_names, code_folder)):
            check_acts(registry.find("agent", kind, key="", origin=Source("vcmvsp agent")), kind, "")
    bundle = None
    if keys is not None:
        from vcmvsp.cosim.security import certificates

        bundle = certificates.load_bundle(keys)
        if warning := bundle.check():
            on_state(warning)
        bundle.speaks_for(vehicles)
    if not token:  # a host that a run starts got a checked endpoint
        endpoint = endpoint_rules(endpoint, bundle, insecure=insecure, side="host")

    def hello(host_id: str) -> Hello:
        return Hello(host_id, PROTOCOL, vehicles, kind=kind, folder=str(Path.cwd()), params=params or {}, token=token)

    with may_load, threadpool_limits(1):  # as in the run: sums come out the same on any number of cores
        dial_secret = endpoints.secret_from(secret, insecure=insecure or bool(token))
        return serve(hello, Desk(AgentHost), endpoint, bundle=bundle, secret=dial_secret, on_state=on_state)


def _end_with_parent(pipe: io.FileIO) -> None:
    """Exit when the pipe closes, which it does however the run's process ends."""
    pipe.read()
    time.sleep(GRACE_S)  # to end by itself, as after a successful run
    os._exit(1)


def main() -> int:
    """Entry point of a host that a run starts."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the run's to handle; it ends its hosts
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connect", required=True)
    parser.add_argument("--vehicle", action="append", required=True)
    options = parser.parse_args()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # what agents print is seen, however this process ends
    pipe = io.FileIO(0, closefd=False)  # unbuffered: a thread that waits in it must not hold a lock when Python exits
    token = pipe.readline().decode().strip()
    threading.Thread(target=_end_with_parent, args=(pipe,), daemon=True).start()
    try:
        host(options.connect, tuple(options.vehicle), token=token)
    except UsageError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_code
    except VcmvspError as error:  # the run has the error and reports it
        return error.exit_code
    return 0
