"""Run a scenario with hosts on other machines, started through ssh and ended with the run (``vcmvsp launch``)."""

import contextlib
import functools
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import msgspec

from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.endpoints import with_slash
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.hosts import ssh_hosts
from vcmvsp.cosim.hosts.ssh_hosts import HostsTable, HostTable
from vcmvsp.cosim.processes.child_process import ending
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.scenario import loader as scenarios
from vcmvsp.cosim.scenario.schema import AgentsTable, Scenario
from vcmvsp.cosim.transport import endpoints
from vcmvsp.cosim.transport.endpoints import endpoint_rules, is_loopback
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.files import write_whole, writing
from vcmvsp.cosim.util.text import Tell

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys

LEAVE_S, ABORT_S = 3.0, 0.5  # for hosts to leave by themselves after a successful run, and after a failed one
END_S = ssh_hosts.KILL_S + 3.0  # to end the hosts


def launch(
    scenario: str | Path | Mapping[str, Any],
    hosts: str | Path,
    *,
    seed: int | None = None,
    set: Mapping[str, Any] | None = None,  # noqa: A002  the word of the command line
    listen: str | None = None,
    keys: str | Path | None = None,
    insecure: bool = False,
    tell: Tell = lambda _: None,
    **options: Any,
) -> api.Result:
    """Run a scenario, with its agents in hosts started for the run and ended before this returns or raises.

    Every agent needs a host, except unlisted ones whose own table in the scenario gives ``agent.runs``. The output of hosts is
    kept in ``hosts/NAME.log`` beside the results.

    Args:
        scenario: as of `vcmvsp.run`.
        hosts: file with the list of hosts (`cosim.hosts.ssh_hosts`).
        seed, set, keys, insecure: as of `vcmvsp.run`.
        listen: endpoint of the run; default: the scenario's ``agents.listen`` or, without one, the hosts' ``connect``.
        tell: receives lines for the user, including the hosts' output.
        options: further arguments of `vcmvsp.run`.

    Raises:
        ScenarioError: the scenario or the file cannot be used as it is.
        UsageError: ssh, a certificate or the like is missing.
        FederateError: a host ended too early. Further errors as of `vcmvsp.run`.
    """
    path, folder = Path(hosts), None if keys is None else Path(keys)
    listed = ssh_hosts.read(path)
    settings = {"agents.runs": "zenoh", **(set or {})}
    parsed, source = scenarios.load(scenario, settings=settings, seed=seed)
    settings |= _placing(path, listed, parsed)
    listen = listen or _listening(parsed.agents, listed)
    tables = [parsed.agents.defaults, *(msgspec.to_builtins(each.agent) for each in parsed.vehicle)]
    here = str(source.folder.resolve())
    code = {}
    for host in listed.host:
        code[host.called] = registry.host_options(tables, "." if host.folder else here)
    plans = _plan(path, listed, listen, folder, code, insecure=insecure, tell=tell)
    result: api.Result | None = None
    with Fleet(plans, path.parent, tell) as fleet:
        try:
            result = api.run(
                scenario,
                seed=seed,
                set=settings,
                listen=listen,
                keys=folder,
                insecure=insecure,
                tell=tell,
                watch=fleet.watch,
                **options,
            )
            fleet.end(LEAVE_S)
        except VcmvspError as error:
            result = error.result
            raise
        finally:
            fleet.end(ABORT_S)
            if result is not None and result.folder is not None:
                fleet.save(result.folder / "hosts")
    return result


class Plan(msgspec.Struct, frozen=True):
    """A host that is ready to start."""

    table: HostTable
    command: list[str]
    makes_script: Callable[..., str]  # `cosim.hosts.ssh_hosts.script` without the secret
    shares: str = ""  # endpoint of a run without certificates, whose secret is sent to the host

    def script(self) -> str:
        """Script for the host's machine; called once the run listens."""
        secret = endpoints.find_secret(self.shares) if self.shares else None
        return self.makes_script(secret=secret or "")


class Fleet:
    """The hosts of a run, started when the run first waits for them and can be reached."""

    def __init__(self, plans: Sequence[Plan], folder: Path, tell: Tell) -> None:
        self._plans, self._folder, self._tell = plans, folder, tell
        self._stack = contextlib.ExitStack()
        self._logs = {plan.table.called: tempfile.TemporaryFile() for plan in plans}  # noqa: SIM115  closed by the stack
        for log in self._logs.values():
            self._stack.enter_context(log)
        self._started: list[ssh_hosts.Far] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self._stack.close()

    def watch(self) -> str | None:
        """Reason why a host will never join, or None; called while the run waits."""
        for plan in self._plans[len(self._started) :]:
            name = plan.table.called
            hear = functools.partial(self._hear, name)
            self._started.append(ssh_hosts.Far(plan.command, plan.script(), self._logs[name], hear, self._folder))
        for plan, far in zip(self._plans, self._started, strict=True):
            if (code := far.code) is not None:
                return _why(plan.table, code, far.last)
        return None

    def end(self, patience_s: float) -> None:
        """End all hosts, after ``patience_s`` to leave by themselves."""
        self._remaining(patience_s)
        for far in self._started:
            far.release()
        for far in self._remaining(END_S):
            far.kill()

    def save(self, folder: Path) -> None:
        """Write the hosts' output, a file for each."""
        with writing(folder):
            folder.mkdir(exist_ok=True)
            for name, log in self._logs.items():
                log.seek(0)
                write_whole(folder / f"{name}.log", log.read())

    def _remaining(self, seconds: float) -> list[ssh_hosts.Far]:
        last = time.monotonic() + seconds
        return [far for far in self._started if not far.wait(max(0.0, last - time.monotonic()))]

    def _hear(self, name: str, text: str) -> None:
        self._tell(f"[{name}] {text}")


def _why(host: HostTable, code: int, last: Sequence[str]) -> str:
    how = f"{ending(code)} before the run began"
    if host.ssh and code == ssh_hosts.SSH_FAILED:
        how = f"ssh cannot connect, or lost the connection (exit code {code})"
    elif code == ssh_hosts.NOT_FOUND:
        how = f"has no '{host.words[0]}' (exit code {code}; command = in its [[host]] says where it is)"
    return f"{host.label}: {how}: {' | '.join(last) or 'no output'}"


def _placing(path: Path, listed: HostsTable, parsed: Scenario) -> dict[str, Any]:
    """Settings that make the run wait for these hosts; an agent that no host runs is an error."""
    agents = {each.name: each.agent for each in parsed.vehicle}
    hosted = [vehicle for host in listed.host for vehicle in host.vehicles]
    for vehicle in hosted:
        if vehicle not in agents:
            raise UsageError(f"{path}: {binding.unknown('vehicle', vehicle, agents)}")
        if agents[vehicle] is None:
            raise UsageError(f"{path}: '{vehicle}' has no agent in the scenario (agent = {{}} gives it the default one)")
    remote = [name for name, agent in agents.items() if agent and (agent.runs or parsed.agents.runs) == "zenoh"]
    if missing := [name for name in remote if name not in hosted]:
        hint = "add them to a [[host]] (without ssh: a process on this machine)"
        raise UsageError(f"{path}: no host runs the agents of {', '.join(missing)}: {hint}")
    return {f"vehicle.{name}.agent.runs": "zenoh" for name in hosted if name not in remote}


def _listening(agents: AgentsTable, listed: HostsTable) -> str:
    """Default endpoint of the run: the scenario's ``agents.listen`` or, without one, the hosts' ``connect``."""
    return listed.connect if listed.connect and agents.listen == AgentsTable().listen else agents.listen


def _plan(
    path: Path,
    listed: HostsTable,
    listen: str,
    folder: Path | None,
    code: Mapping[str, Sequence[str]],
    *,
    insecure: bool,
    tell: Tell,
) -> list[Plan]:
    """Plans of all hosts; issues missing certificates that are to be sent."""
    keys = None
    if folder is not None:
        from vcmvsp.cosim.security import certificates

        keys = certificates.load(folder)
    listen = endpoint_rules(listen, keys, insecure=insecure)
    if listen.endswith(":0"):
        raise UsageError(f"--listen {listen}: hosts need a known port: choose one")
    dialled = [_dialled(path, host, host.connect or listed.connect, listen) for host in listed.host]
    for host, connect in zip(listed.host, dialled, strict=True):
        _check_dialling(f"{path}: {host.label}", host, connect, listen, keys, insecure=insecure)
    if any(host.ssh for host in listed.host) and shutil.which("ssh") is None:
        raise UsageError(f"{path}: ssh is missing on this machine; install the OpenSSH client")
    plans = []
    for host, connect in zip(listed.host, dialled, strict=True):
        bundle = _bundle(keys, host, tell) if keys and host.copy else ""
        command = ssh_hosts.ssh(host.ssh, host.ssh_options) if host.ssh else ["sh"]
        script = functools.partial(
            ssh_hosts.script,
            host.words,
            host.arguments(connect, code[host.called], insecure=insecure),
            last=[] if host.agent is None else [host.agent],
            folder=host.folder,
            keys=host.keys,
            bundle=bundle,
            name=host.called,
        )
        plans.append(Plan(host, command, script, "" if keys or insecure else listen))
    return plans


def _dialled(path: Path, host: HostTable, connect: str | None, listen: str) -> str:
    if connect is not None:
        return with_slash(connect)
    protocol, _, rest = listen.partition("/")
    name, _, port = rest.rpartition(":")
    everywhere = {"0.0.0.0": "127.0.0.1", "[::]": "localhost"}  # noqa: S104  compared, not listened on
    if not host.ssh:
        return f"{protocol}/{everywhere.get(name, name)}:{port}"
    if name in everywhere or is_loopback(name.strip("[]")):
        example = f'connect = "{protocol}/ADDRESS:{port}"'
        raise UsageError(f"{path}: {host.label} cannot connect to {listen}: set the address of this machine, with {example}")
    return listen


def _check_dialling(what: str, host: HostTable, connect: str, listen: str, keys: "Keys | None", *, insecure: bool) -> None:
    """Raise `UsageError` if this host could not join: wrong protocol, or keys missing or superfluous."""
    protocol, used = connect.partition("/")[0], bool(host.keys or host.copy)
    if protocol != listen.partition("/")[0]:
        raise UsageError(f"{what} connects to {connect}, but the run listens at {listen}: use one protocol for both")
    if used and keys is None:
        raise UsageError(f"{what} has keys, but the run has none: add --keys DIR, or remove them")
    if keys and not used:
        raise UsageError(f"{what} has no keys: set copy = true to send them, or keys = FILE for a file on the host")
    endpoint_rules(connect, keys, insecure=insecure, side="host")


def _bundle(keys: "Keys", host: HostTable, tell: Tell) -> str:
    """Content of a host's key bundle, issued if it does not exist."""
    from vcmvsp.cosim.security import authority, certificates

    path = keys.folder / f"{host.called}{certificates.SUFFIX}"
    if path.exists():
        bundle = certificates.load_bundle(path)
        bundle.speaks_for(host.vehicles)
    elif keys.index.find(host.called):
        again = f"vcmvsp keys vehicle {' '.join(host.vehicles)} --as {host.called} --keys {keys.folder} --force"
        raise UsageError(f"{path}: missing, although '{host.called}' has a certificate; make it again with: {again}")
    else:
        bundle = authority.issue(keys.folder, host.called, host.vehicles)
        tell(f"{path}: a new certificate for {', '.join(host.vehicles)}, valid until {bundle.until:%Y-%m-%d}")
    if warning := bundle.check():
        tell(warning)
    return limits.read_text(path)
