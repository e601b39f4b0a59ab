"""One of several kinds, built from its table."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cosim import registry, table
from cosim.errors import ScenarioError
from cosim.source import Source

Portable = Callable[[str], str]
"""From a kind to how the resolved scenario names it."""

Keep = Callable[[Path], str]
"""Keeps a file that the scenario uses; how the resolved scenario names it."""

FILES = ("file", "path")
"""Parameters that name a file, relative to the scenario's folder."""


def name_of(path: Path) -> str:
    """For a scenario that is not kept: the file where it is."""
    return str(path)


def nothing() -> None:
    """Leaves the layer out."""


def build(
    group: str,
    content: Mapping[str, Any],
    *,
    key: str,
    source: Source,
    portable: Portable = str,
    given: Mapping[str, Any] | None = None,
    offered: Mapping[str, Any] | None = None,
    keep: Keep = name_of,
) -> tuple[Any, dict[str, Any]]:
    """Build what a table with a ``kind`` describes.

    Args:
        group: of the registry.
        content: the table.
        key: path of the table in the scenario.
        source: where the scenario came from.
        portable: how the resolved scenario names the kind.
        given: arguments that come from the program, not from the table.
        offered: the same, for those who have such a parameter.
        keep: what becomes of files that it names.

    Returns:
        The object, and the table with all its defaults.
    """
    kind = content.get("kind")
    if not isinstance(kind, str):
        allowed = ", ".join(registry.KINDS[group])
        raise ScenarioError(f"must be a string, one of {allowed}", key=f"{key}.kind", source=source.of(f"{key}.kind"))
    target = registry.find(group, kind, folder=source.folder, key=f"{key}.kind", origin=source)
    known = table.parameters(target)
    given = {**(given or {}), **{name: value for name, value in (offered or {}).items() if name in known}}
    params, files = located(source.kept(content, key, known), source)
    built = table.call(target, params, key=key, origin=source, given=given)
    kept = {name: keep(path) for name, path in files.items()}
    return built, {"kind": portable(kind), **table.complete(target, params, without=given), **kept}


def located(params: Mapping[str, Any], source: Source) -> tuple[dict[str, Any], dict[str, Path]]:
    """Parameters with the files that they name where these really are; and these files."""
    files = {name: (source.folder / params[name]).resolve() for name in FILES if isinstance(params.get(name), str)}
    return {**params, **{name: str(path) for name, path in files.items()}}, files
