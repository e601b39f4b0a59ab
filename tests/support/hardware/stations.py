"""Ground stations under test: missions, and a run that gives orders."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from vcmvsp.cosim.scenario.schema import RealVehicle, SafetyTable
from vcmvsp.cosim.types import Array, Velocity
from vcmvsp.hardware.safety.supervisor import Safety
from vcmvsp.hardware.station.messages import PartSpec, StationMission, StationOrder, StationReport
from vcmvsp.hardware.stations import Station, StationError

BENCH = PartSpec(
    group="driver",
    kind="bench",
    params={"latency_s": 0.01, "rate_hz": 50.0, "accel": 2.0, "decel": 2.0, "command_timeout_s": 2.0},
)
HELD_UP = ("stopped", "the station was delayed, or its clock jumped")


def safety(**changed: Any) -> Safety:
    """Limits of a small robot, with timeouts that a loaded machine meets."""
    usual: dict[str, Any] = {
        "max_speed": 0.5,
        "max_yaw_rate": 1.0,
        "accel": 2.0,
        "decel": 2.0,
        "yaw_accel": 2.0,
        "yaw_decel": 2.0,
        "radius_m": 0.2,
        "command_s": 5.0,
        "positioning_s": 5.0,
        "federation_s": 5.0,
    }
    return Safety(**{**usual, **changed})


def mission(driver: PartSpec = BENCH, vehicle: str = "car1", *, rate_hz: float = 50.0, **changed: Any) -> StationMission:
    """A robot on the ground; ``changed``: keys of its safety."""
    return StationMission(
        run="test",
        vehicle=vehicle,
        folder=".",
        driver=driver,
        localisation=None,
        fusion={},
        start=(0.0, 0.0, 0.0),
        height_m=0.0,
        flies=False,
        safety=safety(**changed),
        rate_hz=rate_hz,
    )


class FakeStation:
    """Sends scripted messages and stores what it receives."""

    def __init__(self) -> None:
        self.saying: list[StationReport] = []
        self.orders: list[StationOrder] = []
        self.failing: StationError | None = None

    def order(self, order: StationOrder) -> bool:
        self.orders.append(order)
        return True

    def reports(self) -> list[StationReport]:
        if self.failing is not None and not self.saying:
            raise self.failing
        pending, self.saying = self.saying, []
        return pending


def real_vehicle(**changes: Any) -> RealVehicle:
    """A software robot on the ground, at the origin."""
    defaults: dict[str, Any] = {
        "name": "car1",
        "kind": "amigobot",
        "folder": ".",
        "driver": "bench",
        "safety": SafetyTable(),
        "pose_source": "truth",
        "start": (0.0, 0.0, 0.0),
        "height_m": 0.0,
        "flies": False,
        "seed": 0,
        "driver_params": {},
        "localisation_params": {},
        "fusion": {},
        **dict.fromkeys(("localisation", "positioning")),
    }
    return RealVehicle(**{**defaults, **changes})


class Run:
    """Gives orders to a station and stores its reports."""

    def __init__(self, station: Station) -> None:
        self.station, self.reports, self._number = station, list[StationReport](), 0

    def order(self, v: float = 0.0, *, stop: str = "", others: Array | None = None) -> None:
        self._number += 1
        now_ns = time.monotonic_ns()
        command = Velocity(linear=(v, 0.0, 0.0))
        self.station.order(
            StationOrder(number=self._number, sent_ns=now_ns, command=command, command_ns=now_ns, stop=stop, others=others)
        )

    def until(self, condition: Callable[[StationReport], object], v: float | None = None, seconds: float = 30.0) -> Any:
        """Drive with this command (None: send none) until a report meets a condition."""
        end = time.monotonic() + seconds
        while True:
            if v is not None:
                self.order(v)
            fresh = self.station.reports()
            self.reports += fresh
            for each in fresh:
                if condition(each):
                    return each
            assert time.monotonic() < end, f"it did not happen; last: {self.reports[-1:]}"
            time.sleep(0.02)

    @property
    def notices(self) -> list[tuple[str, str]]:
        """Notices without the one that a station gives on a machine that delays it."""
        notices = [(each.what, each.cause) for report in self.reports for each in report.notices]
        late = max(each.late_s for each in self.reports) > 0.4
        return [each for each in notices if each != HELD_UP or not late]


@contextmanager
def ready_station(station_mission: StationMission) -> Iterator[Run]:
    """A station that is ready; closed at the end."""
    station = Station.start(station_mission)
    try:
        station.wait_ready()
        yield Run(station)
    finally:
        station.close()
