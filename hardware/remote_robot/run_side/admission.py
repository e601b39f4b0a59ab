"""Admission of robots."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.transport import access_control
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import RobotHello

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys

RELOAD_S = 1.0  # certificates are read at most once in this time


class Admission:
    """Admits robots of one vehicle.

    Args:
        vehicle: name of the vehicle.
        folder: of the authority of their certificates; None: any robot may come.
    """

    def __init__(self, vehicle: str, folder: Path | None) -> None:
        self._vehicle, self._folder = vehicle, folder
        self._current: tuple[float, Keys] | None = None  # time of reading, and the certificates

    def keys(self) -> "Keys | None":
        """Present certificates, at most `RELOAD_S` old: one may be revoked while the driver listens.

        Raises:
            UsageError: they cannot be read.
        """
        if self._folder is None:
            return None
        from vcmvsp.cosim.security import certificates

        now = time.monotonic()
        if self._current is None or now > self._current[0] + RELOAD_S:
            self._current = now, certificates.load(self._folder)
        return self._current[1]

    def refusal(self, name: str, hello: RobotHello) -> str:
        """Reason to reject a robot of the machine ``name`` permanently; empty: admitted."""
        if hello.protocol != messages.PROTOCOL:
            versions = f"this run speaks protocol {messages.PROTOCOL}, the robot {hello.protocol}"
            return f"{versions}: use the same vcmvsp version"
        vehicle = plain(hello.vehicle)
        try:
            keys = self.keys()
        except UsageError as error:
            return f"the run cannot read its certificates ({error})"
        if keys is not None and (denied := access_control.admission(keys, name, [vehicle])):
            return denied
        if hello.vehicle != self._vehicle:
            return f"this is the port of {self._vehicle}, not of {vehicle}"
        return ""
