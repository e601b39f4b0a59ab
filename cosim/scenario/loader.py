"""Load scenarios: parses TOML files once into checked tables (`cosim.scenario.schema`)."""

import copy
import itertools
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

import msgspec

from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.rng import stream
from vcmvsp.cosim.scenario.schema import (
    AgentsTable,
    AgentTable,
    BridgeTable,
    Scenario,
    StationTable,
    VehicleTable,
)
from vcmvsp.cosim.types import Name, NonNegative, Vec3
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.util.documents import DEEPEST, check_depth, read_toml

MOST = 10_000  # vehicles of a scenario: memory and time grow with their number, and with that of their pairs
_PLACES = {"pose": Vec3, "position": Vec3}


class Repeat(msgspec.Struct, frozen=True, kw_only=True):
    """How a vehicle is repeated."""

    count: Annotated[int, msgspec.Meta(ge=1, le=MOST)]  # how many there are; their names get numbers, from 1 on
    columns: Annotated[int, msgspec.Meta(ge=1)] | None = None  # in each row; None: all in one
    spacing: tuple[float, float] = (1.0, 1.0)  # m, between columns (along x) and between rows (along y)
    turn_rad: float = 0.0  # from each to the next, added to the heading
    spread: tuple[NonNegative, NonNegative, NonNegative] = (0.0, 0.0, 0.0)  # m, m, rad: largest offset, drawn by the seed


KEYS = tuple(binding.parameters(Repeat))


def repeated(listed: Sequence[Any], source: Source, seed: int = 0) -> list[Any]:
    """The vehicles, with one copy per ``count`` of repeated ones."""
    counts = [table.get("count", 1) for table in listed if isinstance(table, dict)]
    if (total := sum(each for each in counts if isinstance(each, int))) > MOST:
        raise source.error(f"{total} vehicles are too many (at most {MOST}): lower the counts", "vehicle")
    vehicles: list[Any] = []
    for table in listed:
        vehicles += _copies(table, source, seed) if isinstance(table, dict) else [table]
    return vehicles


def names_copy(raw: Mapping[str, Any], key: str) -> bool:
    """Whether a key path belongs to one copy of a repeated vehicle: ``vehicle.uav7.kind``."""
    group, _, rest = key.partition(".")
    name, listed = rest.partition(".")[0], raw.get("vehicle")
    if group != "vehicle" or not isinstance(listed, list):
        return False
    stems = [str(each.get("name")) for each in listed if isinstance(each, dict) and "count" in each]
    return any(name.startswith(stem) and name[len(stem) :].isdigit() for stem in stems)


def _copies(table: dict[str, Any], source: Source, seed: int) -> list[dict[str, Any]]:
    key = f"vehicle.{table.get('name', '')}"
    own = {name: table[name] for name in KEYS if name in table}
    if not own:
        return [table]
    if "count" not in own:
        raise source.error("needs a count", f"{key}.{next(iter(own))}")
    repeat = binding.call(Repeat, own, key=key, origin=source)
    rest = {name: value for name, value in table.items() if name not in KEYS}
    place = next((name for name in _PLACES if name in rest), "position")
    x, y, last = binding.convert(rest.get(place, (0.0, 0.0, 0.0)), Vec3, key=f"{key}.{place}", origin=source)
    columns, (dx, dy) = repeat.columns or repeat.count, repeat.spacing
    copies = []
    for i in range(repeat.count):
        name, turn = f"{table.get('name', '')}{i + 1}", i * repeat.turn_rad
        copy = {**rest, "name": name, place: [x + i % columns * dx, y + i // columns * dy, last]}
        if any(repeat.spread):
            east, north, further = (stream(seed, f"{name}/start").uniform(-1.0, 1.0, 3) * repeat.spread).tolist()
            copy[place] = [copy[place][0] + east, copy[place][1] + north, last]
            turn += further
        if turn and place == "pose":
            copy["pose"][2] += turn
        elif turn:
            copy["heading"] = binding.convert(rest.get("heading", 0.0), float, key=f"{key}.heading", origin=source) + turn
        copies.append(copy)
    return copies


RESERVED = ("world", "radio", "bridge", "operator", "log", "tf")  # first parts of event keys that belong to no vehicle
NAMED = ("vehicle", "station")  # arrays of tables that key paths reach by name
BUILT_IN = registry.SHIPPED
TABLES = {name: each.annotation for name, each in binding.parameters(Scenario).items() if isinstance(each.annotation, type)}
"""Tables that have no kinds and stand once, by name."""
T = TypeVar("T")


class Loaded(NamedTuple):
    """A scenario and its source."""

    scenario: Scenario
    source: Source


def load(
    scenario: str | Path | Mapping[str, Any], *, settings: Mapping[str, Any] | None = None, seed: int | None = None
) -> Loaded:
    """Read, override and check a scenario.

    Args:
        scenario: a built-in name, the path of a TOML file, or its content as a mapping.
        settings: key path -> value, e.g. ``{"radio.loss.probability": 0.3, "vehicle.car2.kind": "lag"}``.
        seed: replaces the scenario's.

    Raises:
        ScenarioError: a key or value is wrong; names file, key path and allowed values.
    """
    raw, source = _read(scenario)
    settings = {**(settings or {})}
    _check_depth(settings, "--set")
    if seed is not None:  # before a repeated vehicle is copied
        settings.pop("seed", None)
        source.note_set("seed", f"--seed {seed}")
        raw["seed"] = seed
    for key in sorted(settings, key=lambda key: names_copy(raw, key)):  # settings of one copy override settings of all
        if key.count(".") >= DEEPEST:
            raise ScenarioError(f"the key has more than {DEEPEST} parts", source=f"--set {binding.show(key)}")
        value = settings[key]
        source.note_set(key, f"--set {key}={value if isinstance(value, str) and len(value) < 60 else binding.show(value)}")
        assign(raw, key, value, source)
    return Loaded(parse(raw, source), source)


def parse(raw: Mapping[str, Any], source: Source) -> Scenario:
    """Check the content of a scenario file and convert it to tables."""
    _check_depth(raw, source.name)
    if (bad := binding.unfit_number(raw)) is not None:
        raise source.error(binding.problem_of(bad), _path_of(raw, bad))
    agents = _open_table(AgentsTable, raw.get("agents", {}), "defaults", "agents", source)
    bridge = _open_table(BridgeTable, raw.get("bridge", {}), "doors", "bridge", source)
    defaults = _mapping(raw.get("vehicles", {}), "vehicles", source)
    listed = raw.get("vehicle", [])
    if not isinstance(listed, list) or not (listed or raw.get("station")):
        raise source.error("needs at least one [[vehicle]]", "vehicle")
    placed = raw.get("station", [])
    if not isinstance(placed, list):
        raise source.error(f"must be tables [[station]], not {binding.show(placed)}", "station")
    if own := {"name", "pose", "position", "agent", "driver", "localisation"} & {*defaults}:
        raise source.error(f"must not contain {' or '.join(sorted(own))}: set it per vehicle", "vehicles")
    for group, tables in (("vehicle", listed), ("station", placed)):
        for index, each in enumerate(tables):
            _check_named(each, f"{group}[{index}]", source)
    source.stations = frozenset(each["name"] for each in placed)
    listed = repeated(listed, source, raw.get("seed", 0))
    stations = tuple(_station(each, source) for each in placed)
    vehicles = (*(_vehicle(each, defaults, source) for each in listed), *map(_as_vehicle, stations))
    _unique([each.name for each in vehicles], source)
    _used(defaults, listed, source)
    arguments = {"agents": agents, "bridge": bridge, "vehicle": vehicles, "station": stations, "vehicles": defaults}
    arguments |= _with_kinds(raw, source)
    arguments["radio"] = _radio(raw.get("radio", {}), vehicles, source)
    arguments |= _without_kinds(raw, source)
    rest = {name: value for name, value in raw.items() if name not in arguments}
    parsed = binding.call(Scenario, rest, origin=source, arguments=arguments, also=binding.parameters(Scenario))
    _check_window(parsed, source)
    return parsed


def names() -> list[str]:
    """Names of the built-in scenarios."""
    return sorted(path.stem for path in BUILT_IN.glob("*.toml"))


def first_words(name: str) -> str:
    """Description of a built-in scenario: the first sentence of its opening comment."""
    text = (BUILT_IN / f"{name}.toml").read_text("utf-8")
    lines = itertools.takewhile(lambda each: each.startswith("#"), text.splitlines())
    comment = " ".join(line.lstrip("# ") for line in lines if not line.startswith("#:"))  # that is for editors
    return re.split(r"(?<!Fig)\.\s+(?=[A-Z])", comment)[0].rstrip(".") + "."


def path_of(scenario: str | Path) -> Path:
    """The file of a scenario given by name or path, with or without ``.toml``."""
    text = str(scenario)
    if text in names():
        return BUILT_IN / f"{text}.toml"
    path = Path(scenario)
    try:
        for each in (path, Path(f"{text}.toml")):
            if each.is_file():
                return each
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", source=text) from error
    if path.suffix == ".toml" or "/" in text:
        raise ScenarioError("there is no such file" if not path.is_dir() else "is a folder, not a scenario file", source=text)
    raise ScenarioError(binding.unknown("scenario", text, names()) + "; or give the path of a .toml file")


def text_of(scenario: str | Path) -> str:
    """Text of a scenario's file."""
    path = path_of(scenario)
    try:
        return limits.read_text(path, limits.TOML_BYTES)
    except UnicodeDecodeError as error:
        raise ScenarioError("is not a text file in UTF-8", source=str(path)) from error
    except ValueError as error:
        raise ScenarioError(f"cannot be read: {error}", source=str(path)) from error
    except OSError as error:
        raise ScenarioError(f"cannot be read: {error.strerror}", source=str(path)) from error


def table_of(path: Path) -> dict[str, Any]:
    """Unchecked content of a TOML file; empty if it is unreadable or malformed."""
    try:
        return read_toml(limits.read_text(path, limits.TOML_BYTES))
    except (OSError, ValueError):
        return {}


def value_of(text: str) -> Any:
    """The value of ``--set KEY=text``: TOML if it parses as TOML, else the text itself."""
    try:
        parsed = read_toml(f"value = {text}")
    except ValueError:
        return text
    return parsed["value"] if len(parsed) == 1 else text


def settings_of(arguments: Sequence[str], example: str = "radio.loss.probability=0.3") -> dict[str, Any]:
    """Parse ``--set`` arguments into a mapping."""
    settings = {}
    for argument in arguments:
        key, equals, text = argument.partition("=")
        if not equals or not key.strip():
            raise UsageError(f"--set {argument}: write KEY=VALUE, e.g. --set {example}")
        settings[key.strip()] = value_of(text.strip())
    return settings


def _read(scenario: str | Path | Mapping[str, Any]) -> tuple[dict[str, Any], Source]:
    if isinstance(scenario, Mapping):
        _check_depth(scenario, "scenario")
        return msgspec.to_builtins(dict(scenario), enc_hook=_number, str_keys=True), Source("scenario", Path())
    path, text = path_of(scenario), text_of(scenario)
    try:
        name = str(scenario) if path.parent == BUILT_IN else str(path)
        return read_toml(text), Source(name, path.parent, text)
    except ValueError as error:
        raise ScenarioError(f"is not valid TOML: {error}", source=str(path)) from error


def _check_depth(value: object, source: str) -> None:
    try:
        check_depth(value)
    except ValueError as error:
        raise ScenarioError(str(error), source=source) from error


def _number(value: object) -> object:
    """Convert NumPy numbers and arrays, for example from a notebook, to Python's."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise ScenarioError(f"holds a {type(value).__name__}, {binding.show(value)}, which TOML cannot represent")


def assign(raw: dict[str, Any], key: str, value: object, source: Source) -> None:
    """Set one key path; ``vehicle.NAME`` and ``station.NAME`` find one by its name."""
    *parents, last = key.split(".")
    group = key.partition(".")[0]
    if group in NAMED or (group == "radio" and isinstance(raw.get("radio"), list)):
        listed = raw.get(group)
        if len(parents) < 2 or not isinstance(listed, list):
            raise source.error(f"write {group}.NAME.KEY for a key of one {group}", key)
    node: Any = raw
    for depth, part in enumerate(parents):
        if depth == 0 and isinstance(raw.get(part), list):
            if names_copy(raw, key):
                raw["vehicle"] = repeated(raw["vehicle"], source, raw.get("seed", 0))  # one copy gets its own value
            node = {str(each.get("name")): each for each in raw.get(part, []) if isinstance(each, dict)}
        elif depth == 1 and isinstance(raw.get(parents[0]), list) and part not in node:
            raise source.error(binding.unknown(parents[0], part, node), key)
        elif depth == 2 and parents[0] == "vehicle":  # one key of a table in [vehicles]
            node = node.setdefault(part, copy.deepcopy(raw.get("vehicles", {}).get(part, {})))
        else:
            node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise source.error(f"'{'.'.join(parents[: depth + 1])}' is a value, not a table", key)
    node[last] = copy.deepcopy(value)  # the caller's mapping must not change


def _mapping(value: object, key: str, source: Source) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise source.error(f"must be a table, not {binding.show(value)}", key)
    return value


def _open_table(kind: Callable[..., T], raw: object, rest: str, key: str, source: Source) -> T:
    """Build a table of class ``kind``; keys unknown to it go into its field ``rest``."""
    own = {name for name in binding.parameters(kind) if name != rest}
    content = _mapping(raw, key, source)
    others = {name: value for name, value in content.items() if name not in own}
    return binding.call(kind, {n: v for n, v in content.items() if n in own}, key=key, origin=source, arguments={rest: others})


def _check_named(raw: object, path: str, source: Source) -> None:
    """Reject a ``[[vehicle]]`` or ``[[station]]`` that is not a table with a name."""
    key, name = f"{path}.name", _mapping(raw, path, source).get("name")
    if name is None:
        raise source.error("is missing", key)
    binding.convert(name, str, key=key, origin=source)


def _with_kinds(raw: Mapping[str, Any], source: Source) -> dict[str, Any]:
    """The tables of a scenario whose keys belong to kinds."""
    return {name: _mapping(raw[name], name, source) for name in ("physics", "world", "routing", "stack") if name in raw}


def _without_kinds(raw: Mapping[str, Any], source: Source) -> dict[str, Any]:
    """The other tables that stand once, with all their own keys."""
    own = {name: _mapping(raw[name], name, source) for name in TABLES if name in raw and name not in ("agents", "bridge")}
    return {name: binding.call(TABLES[name], table, key=name, origin=source) for name, table in own.items()}


def _vehicle(raw: dict[str, Any], defaults: Mapping[str, Any], source: Source) -> VehicleTable:
    path = f"vehicle.{raw['name']}"
    content = {**defaults, **raw}
    agent = None if "agent" not in content else _open_table(AgentTable, content.pop("agent"), "params", f"{path}.agent", source)
    if "kind" not in content:
        raise ScenarioError("is missing, and [vehicles] has no kind for all", key=f"{path}.kind", source=source.of(path))
    parsed = _open_table(VehicleTable, content, "params", path, source)
    return msgspec.structs.replace(parsed, agent=agent)


def _radio(raw: object, vehicles: Sequence[VehicleTable], source: Source) -> Mapping[str, Any] | tuple[Mapping[str, Any], ...]:
    """``[radio]``, or several ``[[radio]]`` with names."""
    if not isinstance(raw, list):
        return _mapping(raw, "radio", source)
    for index, each in enumerate(raw):
        _check_named(each, f"radio[{index}]", source)
        binding.convert(each["name"], Name, key=f"radio.{each['name']}.name", origin=source)
    names = [each["name"] for each in raw]
    if len({*names}) < len(names):
        raise source.error("two radios have one name; use distinct names", "radio")
    for vehicle in vehicles:
        for name in vehicle.radios or ():
            if name not in names:
                raise source.error(binding.unknown("radio", name, names), f"vehicle.{vehicle.name}.radios")
    return tuple(raw)


def _station(raw: dict[str, Any], source: Source) -> StationTable:
    path = f"station.{raw['name']}"
    own = {name: value for name, value in raw.items() if name != "agent"}
    agent = _open_table(AgentTable, raw["agent"], "params", f"{path}.agent", source) if "agent" in raw else None
    return binding.call(StationTable, own, key=path, origin=source, arguments={"agent": agent}, also=["agent"])


def _as_vehicle(station: StationTable) -> VehicleTable:
    return VehicleTable(kind="station", **msgspec.structs.asdict(station))


def _unique(vehicle_names: Sequence[str], source: Source) -> None:
    for index, name in enumerate(vehicle_names):
        key, problem = f"vehicle.{name}.name", ""
        if name in RESERVED:
            problem = f"'{name}' is a reserved topic; choose another name"
        elif name in vehicle_names[:index]:
            problem = f"two vehicles are named '{name}'; use distinct names"
        if problem:
            raise source.error(problem, key)


def _used(defaults: Mapping[str, Any], listed: Sequence[Mapping[str, Any]], source: Source) -> None:
    for name in defaults:
        if all(name in each for each in listed):
            key = f"vehicles.{name}"
            problem = f"this default has no effect: all vehicles set their own '{name}' (change vehicle.NAME.{name} instead)"
            raise source.error(problem, key)


def _check_window(parsed: Scenario, source: Source) -> None:
    window = parsed.metrics
    if window.to_s is not None and window.to_s < window.from_s:
        raise source.error(f"must not be earlier than metrics.from_s ({window.from_s:g}), not {window.to_s:g}", "metrics.to_s")


def _path_of(value: object, target: float, key: str = "") -> str:
    """Path of an object, by identity, inside a nested value."""
    if value is target:
        return key
    items: Iterable[tuple[object, object]] = ()
    if isinstance(value, Mapping):
        items = value.items()
    elif isinstance(value, list):
        items = enumerate(value)
    for name, each in items:
        own = f"[{name}]" if isinstance(name, int) else f".{name}"
        if key in (*NAMED, "radio") and isinstance(each, dict) and isinstance(each.get("name"), str):
            own = f".{each['name']}"
        if path := _path_of(each, target, f"{key}{own}".removeprefix(".")):
            return path
    return ""
