"""The stations of a run's real vehicles, and the emulated robots among them: opened and closed all at once."""

import time
from collections.abc import Callable, Sequence

import msgspec

from cosim.real import RealVehicle
from hardware.emulated import EMULATED, Emulated
from hardware.station.process import CLOSE_S, READY_S, Station
from hardware.station.wire import Mission, Part, Safety


class Connections:
    """Opens and closes stations.

    Args:
        vehicles: what is driven.
        run: name of the run.
        tell: takes lines for the user.
    """

    def __init__(self, vehicles: Sequence[RealVehicle], run: str, tell: Callable[[str], None]) -> None:
        self._vehicles, self._run, self._tell = vehicles, run, tell
        self._emulated: list[Emulated] = []
        self._stations: dict[str, Station] = {}

    def open(self) -> dict[str, Station]:
        """Start all stations, and wait until each robot stands ready.

        Raises:
            DriverError: one of them cannot be had.
        """
        try:
            for vehicle in self._vehicles:
                self._start(vehicle)
            until = time.monotonic() + READY_S
            for station in self._stations.values():
                station.wait_ready(until)
        except BaseException:
            self.close()
            raise
        return dict(self._stations)

    def _start(self, vehicle: RealVehicle) -> None:
        if vehicle.driver_params.get("port") == EMULATED:
            emulated = Emulated(vehicle)
            self._emulated.append(emulated)
            vehicle = emulated.reached
        self._stations[vehicle.name] = Station.start(mission(vehicle, self._run))

    def close(self) -> None:
        """Have all robots stop, then let go of them; emulated ones go last."""
        until = time.monotonic() + CLOSE_S
        for station in self._stations.values():
            station.leave()
        for station in self._stations.values():
            station.close(until)
        self._stations.clear()
        for emulated in self._emulated:
            emulated.close()
        self._emulated.clear()


def mission(vehicle: RealVehicle, run: str) -> Mission:
    """What the station of a vehicle is told."""
    localisation = None
    if vehicle.localisation is not None:
        localisation = Part(group="localisation", kind=vehicle.localisation, params=vehicle.localisation_params)
    limits = {name: value for name, value in msgspec.structs.asdict(vehicle.safety).items() if value is not None}
    return Mission(
        run=run,
        vehicle=vehicle.name,
        folder=vehicle.folder,
        driver=Part(group="driver", kind=vehicle.driver, params=vehicle.driver_params),
        localisation=localisation,
        fusion=vehicle.fusion,
        start=vehicle.start,
        height_m=vehicle.height_m,
        flies=vehicle.flies,
        safety=Safety(**limits, yaw_decel=limits["yaw_accel"]),
    )
