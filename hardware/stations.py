"""Stations of a run's real vehicles, and emulated robots among them."""

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence

import msgspec

from vcmvsp.cosim.scenario.schema import RealVehicle
from vcmvsp.hardware.emulators.programs.in_run import EMULATED, Emulated
from vcmvsp.hardware.safety import Polygon
from vcmvsp.hardware.station.messages import PartSpec, Safety, StationMission
from vcmvsp.hardware.station.process_client import CLOSE_S, READY_S, Station, StationError
from vcmvsp.hardware.station.safety_factory import guard

COMMAND_S = 0.5  # command time-out


class Connections:
    """Opens and closes all stations together.

    Args:
        vehicles: real vehicles.
        run: name of the run.
        tell: takes lines for the user.
        periods_s: of their agents, by vehicle.
    """

    def __init__(
        self, vehicles: Sequence[RealVehicle], run: str, tell: Callable[[str], None], periods_s: Mapping[str, float]
    ) -> None:
        self._vehicles, self._run, self._tell, self._periods_s = vehicles, run, tell, periods_s
        self._emulated: list[Emulated] = []
        self._stations: dict[str, Station] = {}

    def open(self) -> dict[str, Station]:
        """Start all stations, and wait until each robot is ready.

        Raises:
            DriverError: a robot cannot be connected.
        """
        try:
            for vehicle in self._vehicles:
                self._start(vehicle)
            until = time.monotonic() + READY_S
            for station in self._stations.values():
                station.wait_ready(until)
        except BaseException:
            with contextlib.suppress(StationError):  # already reported
                self.close()
            raise
        return dict(self._stations)

    def _start(self, vehicle: RealVehicle) -> None:
        if vehicle.driver_params.get("port") == EMULATED:
            emulated = Emulated(vehicle)
            self._emulated.append(emulated)
            vehicle = emulated.reached
        self._stations[vehicle.name] = Station.start(mission(vehicle, self._run, self._periods_s.get(vehicle.name, 0.0)))

    def drop(self, name: str) -> None:
        """Close the station of a lost robot."""
        self._stations.pop(name).close(time.monotonic())

    def close(self) -> None:
        """Stop and release all robots; emulated ones are closed last.

        Raises:
            StationError: a station did not end properly; check the robot.
        """
        until = time.monotonic() + CLOSE_S
        for station in self._stations.values():
            station.leave()
        failed = [
            StationError(name, report.failed, report.advice)
            for name, station in self._stations.items()
            for report in station.close(until)
            if report.failed
        ]
        self._stations.clear()
        for emulated in self._emulated:
            emulated.close()
        self._emulated.clear()
        for error in failed:
            self._tell(str(error))
        if failed:
            raise failed[0]


def check_safety(vehicle: RealVehicle) -> None:
    """Raise `ValueError` if safety parameters are invalid, or the start is outside the fence."""
    guard(mission(vehicle, ""))
    x, y, _ = vehicle.start
    fence = vehicle.safety.fence
    if fence is not None and not Polygon(fence).contains(x, y):
        where = f"{vehicle.name} starts outside the fence, at x = {x:g} m, y = {y:g} m"
        raise ValueError(f"{where}: it would stand there; start it inside, or make safety.fence wider")


def mission(vehicle: RealVehicle, run: str, period_s: float = 0.0) -> StationMission:
    """Mission of a vehicle's station; ``period_s`` is the period of its agent."""
    localisation = None
    if vehicle.localisation is not None:
        localisation = PartSpec(group="localisation", kind=vehicle.localisation, params=vehicle.localisation_params)
    limits = {name: value for name, value in msgspec.structs.asdict(vehicle.safety).items() if value is not None}
    limits = {"command_s": max(COMMAND_S, 2.5 * period_s), **limits}
    return StationMission(
        run=run,
        vehicle=vehicle.name,
        folder=vehicle.folder,
        driver=PartSpec(group="driver", kind=vehicle.driver, params=vehicle.driver_params),
        localisation=localisation,
        fusion=vehicle.fusion,
        start=vehicle.start,
        height_m=vehicle.height_m,
        flies=vehicle.flies,
        safety=Safety(**limits, yaw_decel=limits["yaw_accel"]),
    )
