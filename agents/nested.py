"""Agents inside agents: the tables of a scenario that describe them."""

from collections.abc import Mapping
from typing import Any

from agents.building import check_acts
from cosim import registered, registry, table
from cosim.agent import Agent
from cosim.errors import ScenarioError


def built(described: Mapping[str, Any], key: str) -> Agent:
    """The agent that a table describes: its ``kind`` and its parameters; errors name the key inside the table ``key``."""
    kind, where = described.get("kind"), table.join(key, "kind")
    if not isinstance(kind, str):
        allowed = ", ".join(registered.KINDS["agent"])
        raise ScenarioError(f"must be a string, one of {allowed}, module:Class or file.py:Class", key=where)
    found = registry.find("agent", kind, key=where)
    check_acts(found, kind, where)
    params = {name: value for name, value in described.items() if name != "kind"}
    agent: Agent = table.call(found, params, key=key, also=("kind",))
    return agent
