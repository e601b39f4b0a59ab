"""The resolved scenario: every key of every component filled in. Running it gives the same bytes.

It does not say where agents ran, which changes no result. Shared defaults of agents or vehicles stay shared: a study can
still change them in one place.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config import registry as component
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import BatteryTable, ClockTable, Scenario, StationTable, VehicleTable
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.vehicle_clock import VehicleClock


class Resolution:
    """Collects the complete tables and files while a scenario is assembled.

    Attributes:
        tables: the resolved ``[physics]``, ``[world]`` and ``[radio]``.
        vehicles: the parameters of each vehicle's kind, complete.
        sensors: the tables of each vehicle's sensors, complete.
        real: the tables of each real vehicle, complete.
        firmware: the table of each vehicle with firmware, complete.
        metrics: the tables of own metrics, complete.
        files: present content of the files that the scenario uses, by their name beside the resolved scenario.
    """

    def __init__(self, scenario: Scenario, source: Source) -> None:
        self._scenario, self._source = scenario, source
        self.tables: dict[str, Any] = {}
        self.vehicles: dict[str, dict[str, Any]] = {}
        self.sensors: dict[str, dict[str, Any]] = {}
        self.real: dict[str, dict[str, Any]] = {}
        self.firmware: dict[str, dict[str, Any]] = {}
        self.metrics: dict[str, dict[str, Any]] = {}
        self.files: dict[str, bytes] = {}
        self._paths: dict[str, Path] = {}

    def component(
        self,
        group: str,
        content: Mapping[str, Any],
        key: str,
        *,
        arguments: Mapping[str, Any] | None = None,
        offered: Mapping[str, Any] | None = None,
        guard: Callable[[Any], Any] = lambda kind: kind,
    ) -> tuple[Any, dict[str, Any]]:
        """Build the object of a table and keep its files; returns object and complete table (`cosim.config.registry.build`)."""
        return component.build(
            group,
            content,
            key=key,
            source=self._source,
            portable=self.portable,
            arguments=arguments,
            offered=offered,
            keep=self.keep,
            guard=guard,
        )

    def portable(self, kind: str, *, foreign: bool = False) -> str:
        """The kind without a folder; keeps the Python file that it names.

        Args:
            foreign: the kind comes from a remote host, which may name any file here: only files beside the scenario are kept.
        """
        if not registry.is_file_kind(kind):
            return kind
        path = registry.located(kind.rpartition(":")[0], self._source.folder)
        if not path.is_file():  # a remote host's file is not on this machine
            return kind
        if foreign and self._lies_elsewhere(path):
            return kind
        return f"{self.keep(path)}:{kind.rpartition(':')[2]}"

    def keep(self, path: Path) -> str:
        """Keep the present content of a file that the scenario uses; returns its name beside the resolved scenario.

        Raises:
            ScenarioError: the file is too large.
        """
        path, name, number = path.resolve(), path.name, 1
        while self._paths.setdefault(name, path) != path:  # another file has this name
            number += 1
            name = f"{path.stem}-{number}{path.suffix}"
        if name not in self.files:
            try:
                self.files[name] = limits.read_bytes(path, limits.FILE_BYTES)
            except ValueError as error:
                raise ScenarioError(f"{path}: {error}") from error
        return name

    def scenario(
        self, infos: Sequence[AgentInfo], host_kinds: Mapping[str, str], foreign: Collection[str] = ()
    ) -> dict[str, Any]:
        """The resolved scenario, in TOML's types.

        Args:
            infos: the hosts' descriptions of the agents.
            host_kinds: agent classes that hosts run instead of the scenario's, by vehicle.
            foreign: vehicles with remote hosts.
        """
        scenario, agents = self._scenario, self._scenario.agents
        info_of, files = {info.vehicle: info for info in infos}, {name for info in infos for name in info.files}
        shared, of_agents = self._shared_by_vehicles(), self._shared_by_agents(infos)
        agent_of = {
            each.name: self._agent(each, info_of.get(each.name), of_agents, host_kinds, each.name in foreign)
            for each in scenario.vehicle
        }
        placed = [each for each in scenario.vehicle if each.name in self._source.stations]
        return {
            "name": scenario.name,
            "duration_s": scenario.duration_s,
            "seed": scenario.seed,
            **self.tables,
            "agents": {
                **_present(period_s=agents.period_s, latency_s=agents.latency_s, on_lost=agents.on_lost, hold_s=agents.hold_s),
                **{name: self._keep_files_of(value, files) for name, value in of_agents.items()},
            },
            **({"clock": binding.plain(scenario.clock)} if scenario.clock != ClockTable() else {}),
            **({"safety": binding.plain(scenario.safety)} if any("driver" in each for each in self.real.values()) else {}),
            "vehicles": shared,
            "record": binding.plain(scenario.record),
            "metrics": _present(from_s=scenario.metrics.from_s, to_s=scenario.metrics.to_s, own=self.metrics or None),
            **({"study": binding.plain(scenario.study)} if scenario.study.vary else {}),
            "vehicle": [
                {**self._vehicle(each, shared), **agent_of[each.name]} for each in scenario.vehicle if each not in placed
            ],
            **({"station": [{**self._station(each), **agent_of[each.name]} for each in placed]} if placed else {}),
        }

    def _shared_by_agents(self, infos: Sequence[AgentInfo]) -> dict[str, Any]:
        """Defaults for all agents; tables among them are completed as in the first agent that takes them."""
        shared = {}
        for name, value in self._scenario.agents.defaults.items():
            tables = [info.params[name] for info in infos if name in info.taken and isinstance(info.params.get(name), dict)]
            shared[name] = tables[0] if tables else binding.plain(value)
        return shared

    def _shared_by_vehicles(self) -> dict[str, Any]:
        shared = {name: binding.plain(value) for name, value in self._scenario.vehicles.items()}
        if "kind" in shared:
            shared["kind"] = self.portable(shared["kind"])
        if "positioning" in shared:
            shared["positioning"] = _sensor(shared["positioning"])
        shared.pop("sensors", None)  # the vehicles' own tables are complete
        if "radio" in shared and not self._scenario.radios:
            shared["radio"] = self._radio(shared["radio"])
        for name, table in (("battery", BatteryTable), ("clock", VehicleClock)):
            if name in shared:
                shared[name] = binding.plain(binding.convert(shared[name], table, key=f"vehicles.{name}"))
        return shared

    def _vehicle(self, vehicle: VehicleTable, shared: Mapping[str, Any]) -> dict[str, Any]:
        """The table of one vehicle without the shared defaults."""
        full = _present(
            name=vehicle.name,
            kind=self.portable(vehicle.kind),
            **_present(pose=vehicle.pose) or _present(position=vehicle.position, heading=vehicle.heading),
            pose_source=vehicle.pose_source,
            positioning=None if vehicle.positioning is None else _sensor(vehicle.positioning),
            radio=self._radio_of(vehicle),
            radios=vehicle.radios,
            battery=None if vehicle.battery is None else binding.plain(vehicle.battery),
            clock=None if vehicle.clock is None else binding.plain(vehicle.clock),
            sensors=self.sensors[vehicle.name] or None,
            firmware=self.firmware.get(vehicle.name),
        )
        full |= self.vehicles[vehicle.name] | self.real.get(vehicle.name, {})
        return {name: value for name, value in full.items() if name not in shared or value != shared[name]}

    def _radio_of(self, vehicle: VehicleTable) -> dict[str, Any]:
        """The table ``radio`` of a vehicle: complete, but unchanged in a scenario with several radios."""
        return binding.plain(vehicle.radio) if self._scenario.radios else self._radio(vehicle.radio)

    def _radio(self, content: Mapping[str, Any]) -> dict[str, Any]:
        """A radio table, complete, with its file kept."""
        from vcmvsp.netsim.interfaces.layers import Radio

        located = registry.with_real_paths(Radio, content, self._source, "radio")
        return binding.complete(Radio, registry.with_kept_files(Radio, located, self.keep))

    def _station(self, vehicle: VehicleTable) -> dict[str, Any]:
        """The table of a station, to which no shared default applies."""
        full = self._vehicle(vehicle, {})
        return {name: value for name, value in full.items() if name in StationTable.__struct_fields__}

    def _agent(
        self,
        vehicle: VehicleTable,
        info: AgentInfo | None,
        shared: Mapping[str, Any],
        host_kinds: Mapping[str, str],
        foreign: bool,
    ) -> dict[str, Any]:
        """``agent = {...}`` of a vehicle without the shared defaults, with the kind that ran."""
        if info is None:
            return {}
        agents, own = self._scenario.agents, vehicle.agent
        kind = host_kinds.get(vehicle.name) or (own and own.kind) or shared.get("kind") or info.agent
        full = _present(
            kind=None if kind == shared.get("kind") else self.portable(kind, foreign=foreign),
            period_s=float(info.ticks.period / SECOND_NS) if agents.period_s is None or (own and own.period_s) else None,
            latency_s=own.latency_s if own else None,
            fails_s=own.fails_s if own else None,
            on_lost=own.on_lost if own else None,
            hold_s=own.hold_s if own else None,
        )
        inherited = {name for name in info.taken if name in shared and info.params.get(name) == shared[name]}
        params = {
            name: self._keep_files_of(value, info.files, foreign)
            for name, value in info.params.items()
            if name not in inherited
        }
        return {"agent": {**full, **params}}

    def _keep_files_of(self, value: Any, files: Collection[str] = (), foreign: bool = False) -> Any:
        """A parameter of an agent; keeps the Python files (``file.py:Class``) and members of ``files`` that it names."""
        if isinstance(value, dict):
            return {name: self._keep_files_of(each, files, foreign) for name, each in value.items()}
        if isinstance(value, list):
            return [self._keep_files_of(each, files, foreign) for each in value]
        if isinstance(value, str) and value in files:
            path = registry.located(value, self._source.folder)
            return self.keep(path) if path.is_file() and not (foreign and self._lies_elsewhere(path)) else value
        return self.portable(value, foreign=foreign) if isinstance(value, str) else value

    def _lies_elsewhere(self, path: Path) -> bool:
        """Whether a file is neither in the scenario's folder nor shipped with vcmvsp."""
        return not any(path.resolve().is_relative_to(each.resolve()) for each in (self._source.folder, registry.SHIPPED))


def _sensor(content: Mapping[str, Any]) -> dict[str, Any]:
    from vcmvsp.physics.sensors.positioning import Positioning

    return binding.complete(Positioning, content)


def _present(**values: Any) -> dict[str, Any]:
    return {name: binding.plain(value) for name, value in values.items() if value is not None}
