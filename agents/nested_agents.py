"""Agents inside agents: the tables of a scenario that describe them."""

from collections.abc import Mapping
from typing import Any

from vcmvsp.agents.factory import check_acts
from vcmvsp.cosim.agent import Agent
from vcmvsp.cosim.config import binding, builtin_kinds, messages, registry
from vcmvsp.cosim.errors import ScenarioError


def built(described: Mapping[str, Any], key: str) -> Agent:
    """The agent that a table describes: its ``kind`` and its parameters; errors name the key inside the table ``key``."""
    kind, where = described.get("kind"), messages.join(key, "kind")
    if not isinstance(kind, str):
        allowed = ", ".join(builtin_kinds.KINDS["agent"])
        raise ScenarioError(f"must be a string, one of {allowed}, module:Class or file.py:Class", key=where)
    found = registry.find("agent", kind, key=where)
    check_acts(found, kind, where)
    params = {name: value for name, value in described.items() if name != "kind"}
    agent: Agent = binding.call(found, params, key=key, also=("kind",))
    return agent
