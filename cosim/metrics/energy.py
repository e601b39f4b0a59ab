"""Numbers of batteries, from their readings."""

from typing import Any

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Measured

TOPIC = "battery"
_NAMES = {"charge": "charge_left", "used_j": "used_j", "motion_j": "motion_j", "radio_j": "radio_j"}


class BatteryReadings:
    """The last reading of each battery, and the time of the first reading of an empty one."""

    def __init__(self) -> None:
        self._last: dict[str, Measured] = {}
        self._empty_ns: dict[str, int] = {}

    def __bool__(self) -> bool:
        return bool(self._last)

    def take(self, key: str, reading: Measured) -> None:
        """Take a reading of any sensor; those of batteries count."""
        vehicle, _, topic = key.partition("/")
        if topic != TOPIC or not _NAMES.keys() <= reading.values.keys():
            return
        self._last[vehicle] = reading
        if reading.values["charge"] <= 0.0:
            self._empty_ns.setdefault(vehicle, reading.time_ns)

    def metrics(self) -> dict[str, Any]:
        """The numbers of each vehicle with a battery."""
        batteries = {}
        for vehicle, reading in self._last.items():
            empty_ns = self._empty_ns.get(vehicle)
            numbers = {name: reading.values[value] for value, name in _NAMES.items()}
            batteries[vehicle] = {**numbers, "empty_s": None if empty_ns is None else empty_ns / SECOND_NS}
        return batteries
