"""Builds agents, and agents nested in agents, from the tables of a scenario."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vcmvsp.cosim.agent import Agent, AgentSpec
from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import AgentTable


class Kinds:
    """Cache of agent classes: one look-up per host, so that a file is not executed again for every vehicle."""

    def __init__(self) -> None:
        self._classes: dict[tuple[str, str], Any] = {}

    def find(self, spec: AgentSpec) -> Any:
        """The class of an agent."""
        if (spec.kind, spec.folder) not in self._classes:
            key, origin = f"vehicle.{spec.vehicle}.agent.kind", Source(spec.source)
            agent_class = registry.find("agent", spec.kind, folder=Path(spec.folder), key=key, origin=origin)
            self._classes[spec.kind, spec.folder] = agent_class
        return self._classes[spec.kind, spec.folder]


def check_acts(kind: Any, name: str, key: str, source: str = "") -> None:
    """Reject a class that is no agent, or does not define `act`."""
    if not (isinstance(kind, type) and issubclass(kind, Agent)):
        raise ScenarioError(
            f"'{name}' is not derived from vcmvsp.Agent: write class {kind.__name__}(Agent)", key=key, source=source
        )
    if kind.act is Agent.act:
        raise ScenarioError(f"'{name}' has no act(obs, radio) of its own", key=key, source=source)


def files_of(kind: Any, params: Mapping[str, Any]) -> tuple[str, ...]:
    """Files that the parameters of an agent name, unresolved."""
    names: dict[str, None] = {}
    binding.with_files(kind, params, lambda name: str(names.setdefault(name)))
    return tuple(names)


def build(spec: AgentSpec, kinds: Kinds) -> tuple[Agent, dict[str, Any], tuple[str, ...]]:
    """Build the agent of a spec: (agent, all its parameters, the [agents] defaults that it takes)."""
    key, origin = f"vehicle.{spec.vehicle}.agent", Source(spec.source)
    kind = kinds.find(spec)
    check_acts(kind, spec.kind, f"{key}.kind", spec.source)
    parameters = binding.parameters(kind)
    defaults_used = tuple(name for name in spec.defaults if name in parameters and name not in spec.params)
    params = {**{name: spec.defaults[name] for name in defaults_used}, **spec.params}
    params |= {
        name: binding.fitted(params[name], parameters[name].annotation, value)
        for name, value in spec.replaced.items()
        if name in params and name in parameters
    }
    located = binding.with_files(kind, params, lambda name: str(registry.located(name, Path(spec.folder))))
    try:
        with registry.looking_in(Path(spec.folder)):
            agent: Agent = binding.call(kind, located, key=key, origin=origin, also=binding.parameters(AgentTable))
    except ScenarioError as error:
        name = error.key.removeprefix(f"{key}.")
        shared = name.partition(".")[0] in defaults_used  # the first part: the error may be inside a table
        raise (ScenarioError(error.problem, key=f"agents.{name}", source=spec.source) if shared else error) from error
    return agent, binding.complete(kind, params), defaults_used


def build_nested(described: Mapping[str, Any], key: str) -> Agent:
    """Build the agent that a table in another agent's parameters describes; errors name its keys as ``key`` + "."."""
    kind, where = described.get("kind"), binding.join(key, "kind")
    if not isinstance(kind, str):
        allowed = ", ".join(builtin_kinds.KINDS["agent"])
        raise ScenarioError(f"must be a string, one of {allowed}, module:Class or file.py:Class", key=where)
    agent_class = registry.find("agent", kind, key=where)
    check_acts(agent_class, kind, where)
    params = {name: value for name, value in described.items() if name != "kind"}
    return binding.call(agent_class, params, key=key, also=("kind",))
