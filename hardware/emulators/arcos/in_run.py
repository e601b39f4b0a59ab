"""Emulated robot in place of a real vehicle with ``driver.port = "emulated"``, in a process of its own.

Driver, localisation and safety use a pseudo-terminal and datagrams as with a real robot. The robot starts at the scenario's
pose, with a tag as accurate as the positioning sensor of its simulated twin.
"""

import socket
import sys
import time

import msgspec

from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.processes.child_process import LinkedProcess, LocalLink
from vcmvsp.cosim.scenario.schema import RealVehicle
from vcmvsp.cosim.types import Value, Vec3
from vcmvsp.hardware.emulators.arcos.program import KINDS, HostPort, Rig, RobotOptions, Tags, device_of, truth_of
from vcmvsp.hardware.emulators.device_server import LOOPBACK
from vcmvsp.hardware.emulators.tags import Errors
from vcmvsp.hardware.localisation.port_source import address
from vcmvsp.hardware.localisation.ubisense import tag_of

EMULATED = "emulated"
READY_S = 20.0
ERRORS = {"rate_hz": "fix_hz", "sigma_m": "sigma_m", "outlier_probability": "outliers", "outlier_m": "outlier_m"}
"""Errors of the simulated sensor, and their names here."""
SURVIVES_S = 5.0  # time after the run in which the driver, or the watchdog, stops the robot


class EmulatedRobot(Value, frozen=True, kw_only=True):
    """Parameters of the emulated robot."""

    robot: str  # "amigobot", "p2dx", ...
    pose: Vec3
    tags: Tags


class Emulated:
    """Emulated robot of a vehicle; `reached` is the vehicle with the addresses of driver and localisation."""

    def __init__(self, vehicle: RealVehicle) -> None:
        if vehicle.driver != "arcos":
            key = f"vehicle.{vehicle.name}.driver.port"
            raise ScenarioError(f"'{EMULATED}' works only with the driver arcos, not with {vehicle.driver}", key=key)
        localisation = dict(vehicle.localisation_params)
        ubisense = None
        if vehicle.localisation == "ubisense":
            ubisense = HostPort(LOOPBACK, _free(localisation["listen"]))
            localisation["listen"] = f"udp://{ubisense.host}:{ubisense.port}"
        errors = {ERRORS[name]: value for name, value in (vehicle.positioning or {}).items() if name in ERRORS}
        tag = tag_of(localisation.get("tag") or "1")
        robot = EmulatedRobot(
            robot=robot_of(vehicle.driver_params.get("robot", ""), vehicle.kind),
            pose=vehicle.start,
            tags=Tags(ubisense=ubisense, name=tag, errors=Errors(**errors), seed=vehicle.seed),
        )
        self._process = LinkedProcess(__name__, msgspec.json.encode(robot).decode())
        self._link = self._process.link
        driver = {**vehicle.driver_params, "port": self._url()}
        self.reached = msgspec.structs.replace(vehicle, driver_params=driver, localisation_params=localisation)

    def _url(self) -> str:
        self._link.wait(READY_S)
        messages = self._link.receive()
        if not messages:
            late = "" if self._link.ended else f" within {READY_S:g} s"
            self.close()
            raise UsageError(f"the emulated robot did not start{late}; see its messages above")
        return messages[0].decode()

    def close(self) -> None:
        """End the process."""
        self._link.close()
        self._process.close(0.0)


def robot_of(subclass: str, kind: str) -> str:
    """Robot of the subclass that the driver requires; without one, that of the vehicle's kind, or an AmigoBot."""
    of_subclass = {each: name for name, each in KINDS.items()}
    return of_subclass.get(subclass, kind if kind in KINDS else "amigobot")


def _free(listen: str) -> int:
    """Port of this listener; 0 becomes a free one."""
    _, port = address(listen)
    if port:
        return port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        return int(probe.getsockname()[1])


def main() -> None:
    """Entry point of the process: serves the robot until the link to the run ends, and `SURVIVES_S` longer."""
    link = LocalLink(socket.socket(fileno=int(sys.argv[1])))
    robot = msgspec.json.decode(sys.argv[2], type=EmulatedRobot)
    chosen = RobotOptions(tags=robot.tags)
    device = device_of(robot.robot, chosen, robot.pose)
    with Rig(lambda ready: link.send(ready["url"].encode())) as rig:
        rig.fit(chosen.tags)
        rig.serve(device, chosen)
        rig.start(chosen.tags, truth_of(device))
        while not link.ended:
            link.wait(READY_S)
            link.receive()
        time.sleep(SURVIVES_S)


if __name__ == "__main__":
    main()
