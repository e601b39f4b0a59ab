"""The resolved scenario: every key of every component filled in. Running it gives the same bytes.

It does not say where agents ran, which changes no result. Shared defaults of agents or vehicles stay shared: a study can
still change them in one place.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import AgentTable, BatteryTable, ClockTable, Scenario, StationTable, VehicleTable
from vcmvsp.cosim.util import limits
from vcmvsp.cosim.vehicle_clock import VehicleClock

Tables = dict[str, dict[str, Any]]


@dataclass(eq=False)
class Resolution:
    """Collects the complete tables and files while a scenario is assembled."""

    _scenario: Scenario
    _source: Source
    tables: dict[str, Any] = field(default_factory=dict)  # the resolved ``[physics]``, ``[world]`` and ``[radio]``
    vehicles: Tables = field(default_factory=dict)  # parameters of each vehicle's kind
    sensors: Tables = field(default_factory=dict)  # tables of each vehicle's sensors
    real: Tables = field(default_factory=dict)  # tables of each real vehicle
    firmware: Tables = field(default_factory=dict)  # table of each vehicle with firmware
    metrics: Tables = field(default_factory=dict)  # tables of own metrics
    files: dict[str, bytes] = field(default_factory=dict)  # present content, by name beside the resolved scenario
    _paths: dict[str, Path] = field(default_factory=dict)

    def component(self, group: str, content: Mapping[str, Any], key: str, **options: Any) -> tuple[Any, dict[str, Any]]:
        """Build the object of a table and keep its files; returns object and complete table (`cosim.config.registry.build`)."""
        return registry.build(group, content, key=key, source=self._source, portable=self.portable, keep=self.keep, **options)

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
        shared, of_agents = self._shared_by_vehicles(), self._shared_by_agents(infos)
        info_of = {info.vehicle: info for info in infos}
        agent_of = {}
        for each in scenario.vehicle:
            agent_of[each.name] = self._agent(each, info_of.get(each.name), of_agents, host_kinds, each.name in foreign)
        full = {"name": scenario.name, "duration_s": scenario.duration_s, "seed": scenario.seed, **self.tables}
        files = {name for info in infos for name in info.files}
        full["agents"] = {
            **_present(period_s=agents.period_s, latency_s=agents.latency_s, on_lost=agents.on_lost, hold_s=agents.hold_s),
            **{name: self._keep_files_of(value, files) for name, value in of_agents.items()},
        }
        if scenario.clock != ClockTable():
            full["clock"] = binding.plain(scenario.clock)
        if any("driver" in each for each in self.real.values()):
            full["safety"] = binding.plain(scenario.safety)
        full["vehicles"] = shared
        full["record"] = binding.plain(scenario.record)
        full["metrics"] = _present(from_s=scenario.metrics.from_s, to_s=scenario.metrics.to_s, own=self.metrics or None)
        if scenario.study.vary:
            full["study"] = binding.plain(scenario.study)
        stations = [each for each in scenario.vehicle if each.name in self._source.stations]
        vehicles = [each for each in scenario.vehicle if each not in stations]
        full["vehicle"] = [{**self._vehicle(each, shared), **agent_of[each.name]} for each in vehicles]
        if stations:
            full["station"] = [{**self._station(each), **agent_of[each.name]} for each in stations]
        return full

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
            shared["positioning"] = complete_positioning(shared["positioning"])
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
            positioning=complete_positioning(vehicle.positioning),
            radio=vehicle.radio if self._scenario.radios else self._radio(vehicle.radio),  # of several radios: unchanged
            radios=vehicle.radios,
            battery=vehicle.battery,
            clock=vehicle.clock,
            sensors=self.sensors[vehicle.name] or None,
            firmware=self.firmware.get(vehicle.name),
        )
        full |= self.vehicles[vehicle.name] | self.real.get(vehicle.name, {})
        return {name: value for name, value in full.items() if name not in shared or value != shared[name]}

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
        own = vehicle.agent or AgentTable()
        kind = host_kinds.get(vehicle.name) or own.kind or shared.get("kind") or info.agent
        period_s = None
        if self._scenario.agents.period_s is None or own.period_s:
            period_s = float(info.ticks.period / SECOND_NS)
        full = _present(
            kind=None if kind == shared.get("kind") else self.portable(kind, foreign=foreign),
            period_s=period_s,
            latency_s=own.latency_s,
            fails_s=own.fails_s,
            on_lost=own.on_lost,
            hold_s=own.hold_s,
        )
        inherited = {name for name in info.taken if name in shared and info.params.get(name) == shared[name]}
        for name, value in info.params.items():
            if name not in inherited:
                full[name] = self._keep_files_of(value, info.files, foreign)
        return {"agent": full}

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


def complete_positioning(content: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The complete table of a positioning sensor; None: the vehicle carries none."""
    if content is None:
        return None
    from vcmvsp.physics.sensors.positioning import Positioning

    return binding.complete(Positioning, content)


def _present(**values: Any) -> dict[str, Any]:
    return {name: binding.plain(value) for name, value in values.items() if value is not None}
