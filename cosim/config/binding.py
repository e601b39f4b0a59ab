"""Call a function or class with a TOML table: checks keys against parameters and values against annotations.

Everything that a scenario configures, from the scenario itself to a user's agent, goes through `call`. Defaults stand in the
signature only, and every error names the problem, the key, the file, and what is allowed.
"""

import collections.abc
import difflib
import functools
import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

import msgspec

from vcmvsp.cosim.config.provenance import NOWHERE, Source
from vcmvsp.cosim.errors import ScenarioError, place_of, text_of, words_of
from vcmvsp.cosim.util.documents import parts_of

T = TypeVar("T")


class Parameter(msgspec.Struct, frozen=True):
    """One parameter of a callable: its annotation, and its default unless it is required."""

    annotation: object
    default: Any
    required: bool


def parameters(target: Callable[..., Any]) -> Mapping[str, Parameter]:
    """The parameters that a table can give to ``target`` (a class or function), in order.

    A class with ``**more`` is assumed to pass it to its base class, whose parameters are included.
    """
    return _parameters(target)


@functools.lru_cache(maxsize=256)
def _parameters(target: Callable[..., object]) -> Mapping[str, Parameter]:
    holder = target
    if isinstance(target, type):
        holder = next(vars(base)["__init__"] for base in target.__mro__ if "__init__" in vars(base))
    try:
        hints = typing.get_type_hints(holder, include_extras=True)
    except (NameError, TypeError):
        hints = {}
    factories: dict[str, Callable[[], Any]] = {}  # factories of mutable defaults
    if isinstance(target, type) and issubclass(target, msgspec.Struct):
        hints = typing.get_type_hints(target, include_extras=True)
        factories = {
            each.name: each.default_factory for each in msgspec.structs.fields(target) if callable(each.default_factory)
        }
    by_name: dict[str, Parameter] = {}
    for name, parameter in inspect.signature(target).parameters.items():
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY):
            required = parameter.default is parameter.empty
            default = factories[name]() if name in factories else parameter.default
            by_name[name] = Parameter(hints.get(name, Any), None if required else default, required)
        elif parameter.kind is parameter.VAR_KEYWORD and isinstance(target, type):  # passed to the next class of the MRO
            line = [base for base in target.__mro__ if "__init__" in vars(base)]
            by_name |= {name: each for name, each in _parameters(line[1]).items() if name not in by_name}
    return types.MappingProxyType(by_name)


def call(
    target: Callable[..., T],
    table: Mapping[str, Any],
    *,
    key: str = "",
    origin: Source = NOWHERE,
    arguments: Mapping[str, Any] | None = None,
    also: Iterable[str] = (),
) -> T:
    """Call ``target`` with the table's values, checked and converted by their annotations.

    Args:
        arguments: values from the program instead of the table.
        also: other keys allowed in this table, for messages.

    Raises:
        ScenarioError: unknown or missing key, wrong type or range, or any error of ``target``.
    """
    arguments = arguments or {}
    known = {name: each for name, each in parameters(target).items() if name not in arguments}
    for name in table:
        if name not in known:
            where = join(key, name)
            raise origin.error(unknown("key", name, [*known, *also]), where)
    values = dict(_values(known, table, key, origin))
    try:
        return target(**arguments, **values)
    except ScenarioError as error:
        if error.source:
            raise
        where = join(key, error.key)
        raise origin.error(error.problem, where) from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # a user class may raise anything
        problem = text = text_of(error)
        if not isinstance(error, ValueError):
            problem = f"{target.__name__} raised {words_of(error)}{place_of(error)}"
        mentioned = [name for name in values if re.search(rf"\b{name}\b", text)]  # parameters named in its message
        where = join(key, mentioned[0]) if len(mentioned) == 1 and _is_named(mentioned[0], text) else key
        raise origin.error(problem, where) from error


def _values(known: Mapping[str, Parameter], table: Mapping[str, Any], key: str, origin: Source) -> Iterator[tuple[str, Any]]:
    for name, parameter in known.items():
        where = join(key, name)
        if name in table:
            yield name, convert(table[name], parameter.annotation, key=where, origin=origin)
        elif parameter.required:
            raise ScenarioError(f"is missing; it must be {describe(parameter.annotation)}", key=where, source=origin.of(key))


def _is_named(name: str, problem: str) -> bool:
    """Whether a word in a message names a parameter: it is first, quoted, followed by a value, or not an English word."""
    return "_" in name or re.search(rf"^{name}\b|['\"`]{name}['\"`]|\b{name} ?[=:'\"]", problem) is not None


def fitted(value: object, annotation: object, keys: Collection[str]) -> object:
    """A table whose kind was replaced, without keys unknown to the new kind; keys in ``keys`` stay."""
    tables = [each for each in structs(annotation) if each.__struct_config__.tag_field and _may_be(each, value)]
    if len(tables) != 1 or not isinstance(value, Mapping):
        return value
    known = {*_table_keys(tables[0], value), *keys}
    return {name: each for name, each in value.items() if name in known}


def complete(target: Callable[..., Any], table: Mapping[str, Any], without: Iterable[str] = ()) -> dict[str, Any]:
    """The table with all defaults of ``target``, in TOML types; None and values without a TOML type are left out."""
    skipped, full = frozenset(without), {}
    for name, parameter in parameters(target).items():
        if name not in skipped:
            value = plain(convert(table[name], parameter.annotation) if name in table else parameter.default)
            if value is not None:
                full[name] = value
    return full


def with_files(target: Callable[..., Any], table: Mapping[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """The table with changed file names: values that ``target`` annotates as `FileName` or ``pathlib.Path``, at any depth."""
    known = parameters(target)
    changed = {name: _with_files(each, known[name].annotation, change) for name, each in table.items() if name in known}
    return {**table, **changed}


def _with_files(value: Any, annotation: object, change: Callable[[str], str]) -> Any:
    if isinstance(value, str):
        return change(value) if value and _names_file(annotation) else value
    if isinstance(value, Mapping):
        items = [typing.get_args(each)[1] for each in _alternatives(annotation) if typing.get_origin(each) in (dict, Mapping)]
        annotations = dict.fromkeys(value, items[0] if items else Any)
        if not items:
            annotations |= {name: each.annotation for name, each in _table_keys(annotation, value).items()}
        return {name: _with_files(each, annotations[name], change) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [_with_files(each, _item(annotation, number), change) for number, each in enumerate(value)]
    return value


def _alternatives(annotation: object) -> list[object]:
    inner = typing.get_args(annotation) if typing.get_origin(annotation) in (typing.Union, types.UnionType) else (annotation,)
    return list(inner)


def _names_file(annotation: object) -> bool:
    metas = [meta for each in _alternatives(annotation) for meta in typing.get_args(each)[1:] if isinstance(meta, msgspec.Meta)]
    return Path in _alternatives(annotation) or any((meta.extra or {}).get("file") for meta in metas)


def _holds_path(annotation: object) -> bool:
    return annotation is Path or bool(structs(annotation)) or any(map(_holds_path, typing.get_args(annotation)))


def _path(kind: type, value: object) -> Path:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise TypeError(f"no {kind.__name__}")


def _text(value: object) -> str:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} is not a type of TOML")


def plain(value: object) -> Any:
    """The value in TOML types; None if it has none."""
    try:
        return _without_none(msgspec.to_builtins(value, builtin_types=(), enc_hook=_text))
    except TypeError:
        return None


def _without_none(value: object) -> object:
    if isinstance(value, dict):
        return {name: _without_none(each) for name, each in value.items() if each is not None}
    if isinstance(value, list | tuple):
        return [_without_none(each) for each in value]
    return value


def convert(value: object, annotation: object, *, key: str = "", origin: Source = NOWHERE) -> Any:
    """The value converted to its annotation; `ScenarioError` with the allowed values if it does not fit."""
    if (bad := unfit_number(value)) is not None:
        raise origin.error(problem_of(bad), key)
    try:
        return msgspec.convert(value, annotation, dec_hook=_path if _holds_path(annotation) else None)
    except msgspec.ValidationError as error:
        words, _, inside = str(error).partition(" - at `$")
        if isinstance(error.__cause__, ValueError):  # raised by a table's own check
            raise origin.error(words, f"{key}{inside[:-1]}") from error
        if structs(annotation) and (inside or words.startswith("Object ")):
            raise origin.error(_inside(words, inside[:-1], value, annotation), f"{key}{inside[:-1]}") from error
        raise origin.error(unlike(value, annotation), key) from error
    except TypeError:
        return value  # an annotation for Python objects only; the target checks the value


def _inside(words: str, path: str, value: Any, annotation: object) -> str:
    """The problem at a path such as ``[0].size`` inside nested tables and lists of tables."""
    for step in re.findall(r"\w+", path):
        if step.isdigit():
            value, annotation = value[int(step)], _item(annotation, int(step))
        elif step in (known := _table_keys(annotation, value)):
            value, annotation = value[step], known[step].annotation
        else:
            return words
    if field := re.fullmatch(r"Object contains unknown field `(.*)`", words):
        return unknown("key", field[1], _table_keys(annotation, value))
    if field := re.fullmatch(r"Object missing required field `(.*)`", words):
        return f"{field[1]} is missing; it must be {describe(_table_keys(annotation, value)[field[1]].annotation)}"
    return unlike(value, annotation)


def _item(annotation: object, number: int) -> object:
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return _item(inner[0], number)
    if origin in (typing.Union, types.UnionType):
        return next((item for each in inner if (item := _item(each, number)) is not Any), Any)
    if len(inner) == 1 or inner[-1:] == (Ellipsis,):
        return inner[0]
    return inner[number] if number < len(inner) else Any  # of a union, the items may be those of another type


def _table_keys(annotation: object, value: object) -> dict[str, Parameter]:
    """Keys of the table types that a value of this annotation may have."""
    tables = [each for each in structs(annotation) if _may_be(each, value)] or structs(annotation)
    return {name: each for struct in tables for name, each in parameters(struct).items()} | _tags(tables)


def _may_be(struct: type[msgspec.Struct], value: object) -> bool:
    """Whether a value may be a table of this type: its tag, if given, is not another one."""
    config = struct.__struct_config__
    return not config.tag_field or not isinstance(value, Mapping) or value.get(config.tag_field, config.tag) == config.tag


def _tags(tables: Iterable[type[msgspec.Struct]]) -> dict[str, Parameter]:
    """The tag keys of several table types, and the allowed tags of each."""
    words: dict[str, list[Any]] = {}
    for each in tables:
        if (config := each.__struct_config__).tag_field:
            words.setdefault(config.tag_field, []).append(config.tag)
    return {name: Parameter(Literal[tuple(allowed)], None, required=True) for name, allowed in words.items()}


def structs(annotation: object) -> list[type[msgspec.Struct]]:
    """The table types in an annotation."""
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        return [annotation]
    return [each for inner in typing.get_args(annotation) for each in structs(inner)]


def unfit_number(value: object) -> float | None:
    """The first NaN, infinity or integer of more than 64 bits in a value, or None."""
    if isinstance(value, int):
        return None if -(2**63) <= value < 2**64 else value
    if isinstance(value, float):
        return None if math.isfinite(value) else value
    return next((bad for each in parts_of(value) if (bad := unfit_number(each)) is not None), None)


def problem_of(bad: float) -> str:
    """The problem of an unfit number, in words."""
    return "must fit into 64 bits" if isinstance(bad, int) else f"must be finite, not {bad}"


def unknown(what: str, name: str, allowed: Iterable[str]) -> str:
    """Message for an unknown name: ``unknown key 'probabilty'; did you mean 'probability'? (allowed: ...)``."""
    names = sorted(set(allowed))
    near = difflib.get_close_matches(name, names, n=1)
    guess = f"; did you mean '{near[0]}'?" if near else ""
    return f"unknown {what} '{name}'{guess} (allowed: {', '.join(names) or 'none'})"


def unlike(value: object, annotation: object) -> str:
    """Message for a value that does not fit: the allowed values, and the closest of a choice."""
    problem = f"must be {describe(annotation)}, not {show(value)}"
    choices = [each for each in typing.get_args(annotation) if isinstance(each, str)]
    near = difflib.get_close_matches(value, choices, n=1) if isinstance(value, str) else []
    return f"{problem}; did you mean '{near[0]}'?" if near else problem


def describe(annotation: object) -> str:
    """The values that an annotation allows, in words."""
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        limits = [(words, getattr(meta, name)) for meta in inner[1:] for name, words in _LIMITS]
        bounds = [words.format(limit) for words, limit in limits if limit is not None]
        return f"{describe(inner[0])} {' and '.join(bounds)}".rstrip()
    if origin is typing.Literal:
        return f"one of {', '.join(map(repr, inner))}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(dict.fromkeys(describe(each) for each in inner if each is not type(None)))
    if origin is tuple and inner[-1] is not Ellipsis:
        return f"a list of {len(inner)} values, each {' / '.join(dict.fromkeys(map(describe, inner)))}"
    if origin in (tuple, list, collections.abc.Sequence):
        return f"a list, each item {describe(inner[0])}"
    if origin in (dict, collections.abc.Mapping) or annotation is dict:
        return "a table"
    if isinstance(annotation, type) and issubclass(annotation, msgspec.Struct):
        tag = annotation.__struct_config__.tag_field
        return f"a table with its {tag}" if tag else "a table"
    return _WORDS.get(annotation, f"a {getattr(annotation, '__name__', annotation)}")


def join(*parts: str) -> str:
    """Join the parts that are not empty into a key path."""
    return ".".join(part for part in parts if part)


def show(value: object) -> str:
    """The value for a message, shortened if long; its type if ``repr`` fails, as for integers of 4301 digits."""
    try:
        text = repr(value)
    except Exception:
        text = f"a {type(value).__name__} without a printable form"
    return text if len(text) <= 60 else text[:57] + "..."


_LIMITS = (("gt", "> {:g}"), ("ge", ">= {:g}"), ("lt", "< {:g}"), ("le", "<= {:g}"), ("pattern", "matching {}"))
_WORDS: dict[object, str] = {
    Any: "any value",
    float: "a number",
    int: "a whole number",
    str: "a string",
    Path: "the name of a file",
    bool: "true or false",
}
