"""The vehicles of a scenario: what each is, what it carries, and what physics is told of them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vcmvsp.cosim.agent import SHOWN
from vcmvsp.cosim.assembly.resolved import Resolution
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.scenario.schema import Scenario, VehicleTable

if TYPE_CHECKING:
    from vcmvsp.physics.sensors.sensor import Sensor
    from vcmvsp.physics.vehicles.specification import Vehicle, VehicleSpec

TOPICS = (
    *("state", "estimate", "odometry", "fix", "command", "send", "heard", "note", "follows", "host", "real", "incident"),
    *SHOWN.values(),
)
"""Of every vehicle."""
_NOT_SHARED = {"name", "pose", "position", "agent", "driver", "localisation", "params"}
"""Keys of a vehicle for which [vehicles] has no default."""


class Fleet:
    """All vehicles, with their sensors.

    Args:
        scenario: tells of them.
        source: where it was read from.
        resolution: is told what they are with everything filled in.

    Attributes:
        models: what each vehicle is, an object of the class that its kind names, by vehicle.
        sensors: what each vehicle carries, by vehicle and by the sensor's name.

    Raises:
        ScenarioError: a table of theirs is wrong, or no vehicle has what ``[vehicles]`` or ``record.sensors`` speaks of.
    """

    def __init__(self, scenario: Scenario, source: Source, resolution: Resolution) -> None:
        self._scenario, self._source, self._resolution = scenario, source, resolution
        self._classes: dict[str, type[Vehicle]] = {}  # of vehicles, by kind
        self.models: Mapping[str, Vehicle] = {each.name: self._model(each) for each in scenario.vehicle}
        self.sensors: Mapping[str, Mapping[str, Sensor]] = {each.name: self._fit(each) for each in scenario.vehicle}
        self._check_defaults_taken()
        self._check_recorded()

    def specs(self) -> "list[VehicleSpec]":
        """What physics is told of each, in the scenario's order."""
        return [self._spec(each) for each in self._scenario.vehicle]

    def recorded(self) -> set[str]:
        """The readings that are recorded, ``vehicle/sensor``."""
        kept = self._scenario.record.sensors
        return {f"{v}/{s}" for v, fitted in self.sensors.items() for s in fitted if s in kept or "*" in kept}

    def _class(self, vehicle: VehicleTable) -> "type[Vehicle]":
        """The class of a vehicle's kind, looked up once: a file is not executed again for every vehicle."""
        if vehicle.kind not in self._classes:
            key = f"vehicle.{vehicle.name}.kind"
            found = registry.find("vehicle", vehicle.kind, folder=self._source.folder, key=key, origin=self._source)
            self._classes[vehicle.kind] = found
        return self._classes[vehicle.kind]

    def _own(self, vehicle: VehicleTable) -> dict[str, Any]:
        """The parameters of a vehicle; a default of ``[vehicles]`` counts only where the kind takes it."""
        known = binding.parameters(self._class(vehicle))
        defaults = self._scenario.vehicles
        params = self._source.kept(vehicle.params, f"vehicle.{vehicle.name}", known)
        return {n: v for n, v in params.items() if n in known or n not in defaults}

    def _model(self, vehicle: VehicleTable) -> "Vehicle":
        key, kind = f"vehicle.{vehicle.name}", self._class(vehicle)
        own, also = (
            registry.found(kind, self._own(vehicle), self._source, key),
            {*binding.parameters(VehicleTable)} - {"params"},
        )
        self._resolution.vehicles[vehicle.name] = registry.kept(kind, binding.complete(kind, own), self._resolution.keep)
        model: Vehicle = binding.call(kind, own, key=key, origin=self._source, also=also)
        return model

    def _fit(self, vehicle: VehicleTable) -> "dict[str, Sensor]":
        """The sensors of a vehicle, by name; those that ask for its wheels are told."""
        model = self.models[vehicle.name]
        wheels = {name: getattr(model, name) for name in ("wheel_radius_m", "track_m") if hasattr(model, name)}
        fitted, tables = {}, {}
        for name, content in vehicle.sensors.items():
            where = f"vehicle.{vehicle.name}.sensors.{name}"
            if not name.replace("_", "").replace("-", "").isalnum() or name in TOPICS:
                problem = f"a sensor cannot be called '{name}': letters, digits, _ and -, and none of {', '.join(TOPICS)}"
                raise ScenarioError(problem, key=where, source=self._source.of(where))
            fitted[name], tables[name] = self._resolution.component("sensor", content, where, offered=wheels)
        self._resolution.sensors[vehicle.name] = tables
        return fitted

    def _spec(self, vehicle: VehicleTable) -> "VehicleSpec":
        from vcmvsp.physics.sensors.positioning import Positioning
        from vcmvsp.physics.vehicles.specification import VehicleSpec

        key, sensor, fusion = f"vehicle.{vehicle.name}", None, None
        if vehicle.positioning is not None:
            sensor = binding.call(Positioning, vehicle.positioning, key=f"{key}.positioning", origin=self._source)
        position, heading = vehicle.start
        if vehicle.pose_source == "fusion" and not vehicle.is_real:
            from vcmvsp.cosim.estimation.fusion import Fusion  # takes SciPy, and so its time

            at = {"start": (position[0], position[1], heading)}
            fusion = binding.call(Fusion, vehicle.fusion, key=f"{key}.fusion", origin=self._source, given=at)
            self._resolution.real[vehicle.name] = {"fusion": binding.complete(Fusion, vehicle.fusion, without=at)}
        simulated = self.sensors[vehicle.name]
        if vehicle.is_real:  # a real robot has its own
            simulated = {name: each for name, each in simulated.items() if name != "sonar"}
        given = {
            "name": vehicle.name,
            "model": self.models[vehicle.name],
            "position": position,
            "heading": heading,
            "pose_source": vehicle.pose_source,
            "positioning": sensor,
            "fusion": fusion,
            "sensors": simulated,
        }
        spec: VehicleSpec = binding.call(VehicleSpec, {}, key=key, origin=self._source, given=given)
        return spec

    def _check_defaults_taken(self) -> None:
        known = {key for each in self._scenario.vehicle for key in binding.parameters(self._class(each))}
        for name in self._scenario.vehicles:
            if name not in VehicleTable.__struct_fields__ and name not in known:
                key, allowed = f"vehicles.{name}", {*known, *binding.parameters(VehicleTable)} - _NOT_SHARED
                problem = f"no vehicle takes this default: {binding.unknown('key', name, allowed)}"
                raise ScenarioError(problem, key=key, source=self._source.of(key))

    def _check_recorded(self) -> None:
        fitted = {name for each in self.sensors.values() for name in each}
        if unfit := [name for name in self._scenario.record.sensors if name not in fitted | {"*"}]:
            problem = f"no vehicle carries it: {binding.unknown('sensor', unfit[0], fitted | {'*'})}"
            raise ScenarioError(problem, key="record.sensors", source=self._source.of("record.sensors"))
