"""One of several kinds, built from its table."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vcmvsp.cosim.config import binding, builtin_kinds, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError

Portable = Callable[[str], str]
"""From a kind to how the resolved scenario names it."""

Keep = Callable[[Path], str]
"""Keeps a file that the scenario uses; how the resolved scenario names it."""


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
    absent: Mapping[str, Any] | None = None,
    keep: Keep = name_of,
    guard: Callable[[Any], Any] = lambda kind: kind,
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
        absent: arguments for parameters whose default is None, where the table has none.
        keep: what becomes of files that it names.
        guard: from the class that was found to the one that is built.

    Returns:
        The object, and the table with all its defaults.
    """
    kind = content.get("kind")
    if not isinstance(kind, str):
        allowed = ", ".join(builtin_kinds.KINDS[group])
        raise ScenarioError(f"must be a string, one of {allowed}", key=f"{key}.kind", source=source.of(f"{key}.kind"))
    target = guard(registry.find(group, kind, folder=source.folder, key=f"{key}.kind", origin=source))
    known = binding.parameters(target)
    given = {**(given or {}), **{name: value for name, value in (offered or {}).items() if name in known}}
    params = found(target, source.kept(content, key, known), source, key)
    unset = {name for name, each in known.items() if each.default is None and not each.required} - {*params, *given}
    given |= {name: value for name, value in (absent or {}).items() if name in unset}
    built = binding.call(target, params, key=key, origin=source, given=given)
    for path in getattr(built, "files", tuple)():  # those that its own files name
        if path.is_file():  # else whoever reads it says so
            keep(path)
    return built, {"kind": portable(kind), **kept(target, binding.complete(target, params, without=given), keep)}


def found(target: Callable[..., Any], params: Mapping[str, Any], source: Source, key: str) -> dict[str, Any]:
    """The parameters of ``target``, at a key path, with the files that they name where these really are."""
    try:
        return binding.with_files(target, params, lambda name: str(registry.located(name, source.folder)))
    except ScenarioError as error:
        raise ScenarioError(error.problem, key=key, source=source.of(key)) from error


def kept(target: Callable[..., Any], params: Mapping[str, Any], keep: Keep) -> dict[str, Any]:
    """The parameters with the files that they name kept, as far as there are such, by the names under which they are."""
    return binding.with_files(target, params, lambda name: keep(Path(name)) if Path(name).is_file() else name)
