"""A real vehicle whose ``driver.port`` is ``emulated``: a robot in software takes its place, in a process of its own.

Nothing else changes: driver, localisation and safety see a pseudo-terminal and datagrams, and cannot tell. The robot starts
where the scenario says, and wears a tag that is as good as the positioning sensor of its simulated twin.
"""

import json
import os
import socket
import subprocess
import sys
import time
from typing import Any

import msgspec

from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.processes.child_process import BOOT
from vcmvsp.cosim.scenario.schema import RealVehicle
from vcmvsp.cosim.types import Value, Vec3
from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.emulators.device_server import LOOPBACK
from vcmvsp.hardware.emulators.positioning.tags import Errors
from vcmvsp.hardware.emulators.programs.arcos import KINDS, Rig, device_of
from vcmvsp.hardware.emulators.programs.options import PtyPort, RobotOptions, Tags, UdpAddress
from vcmvsp.hardware.localisation.datagrams import address
from vcmvsp.hardware.localisation.ubisense import tag_of

EMULATED = "emulated"
READY_S = 20.0
SURVIVES_S = 5.0  # a robot outlives the run by so much, in which its driver, or its watchdog, stops it


class Wanted(Value, frozen=True, kw_only=True):
    """The robot that is to be emulated."""

    robot: str  # "amigobot", "p2dx", ...
    pose: Vec3
    ubisense: tuple[str, int] | None
    tag: str
    errors: Errors
    seed: int


class Emulated:
    """The emulated robot of a vehicle; `reached` is the vehicle with what its driver and localisation are to connect to."""

    def __init__(self, vehicle: RealVehicle) -> None:
        if vehicle.driver != "arcos":
            key = f"vehicle.{vehicle.name}.driver.port"
            raise ScenarioError(f"'{EMULATED}' is known to the driver arcos alone, not to {vehicle.driver}", key=key)
        localisation = dict(vehicle.localisation_params)
        address = None
        if vehicle.localisation == "ubisense":
            address = _free(localisation["listen"])
            localisation["listen"] = f"udp://{address[0]}:{address[1]}"
        wanted = Wanted(
            robot=_robot(vehicle.driver_params.get("robot", "")),
            pose=vehicle.start,
            ubisense=address,
            tag=localisation.get("tag") or "1",
            errors=_errors(vehicle.positioning or {}),
            seed=vehicle.seed,
        )
        command = [
            sys.executable,
            "-P",
            "-c",
            BOOT.format(module="vcmvsp.hardware.emulators.programs.in_run"),
            msgspec.json.encode(wanted).decode(),
        ]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=sys.__stderr__, process_group=0
        )
        assert self._process.stdin is not None  # noqa: S101
        self._process.stdin.write(f"{json.dumps(sys.path)}\n".encode())
        self._process.stdin.flush()
        driver = {**vehicle.driver_params, "port": self._url()}
        self.reached = msgspec.structs.replace(vehicle, driver_params=driver, localisation_params=localisation)

    def _url(self) -> str:
        """Where it is served: the first thing that the process says."""
        out = self._process.stdout
        assert out is not None  # noqa: S101
        spoke = readable([out.fileno()], READY_S)
        line = out.readline() if spoke else b""
        if not line:
            self.close()
            late = "" if spoke else f" within {READY_S:g} s"
            raise UsageError(f"the emulated robot did not start{late}; look at what it says above")
        url: str = json.loads(line)["url"]
        return url

    def close(self) -> None:
        """Unplug it."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        self._process.kill()
        self._process.wait()


def _robot(subclass: str) -> str:
    """What `hardware.emulators.programs` calls the robot that tells this subclass."""
    return next((name for name, each in KINDS.items() if each == subclass), "amigobot")


def _errors(positioning: dict[str, Any]) -> Errors:
    """Those of the simulated sensor, under the names that they have here."""
    known = {"rate_hz": "fix_hz", "sigma_m": "sigma_m", "outlier_probability": "outliers", "outlier_m": "outlier_m"}
    return Errors(**{known[name]: value for name, value in positioning.items() if name in known})


def _free(listen: str) -> tuple[str, int]:
    """Where datagrams are to go that are listened for there; port 0 becomes one that is free."""
    _, port = address(listen)
    if port:
        return LOOPBACK, port
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind((LOOPBACK, 0))
        return LOOPBACK, int(probe.getsockname()[1])


def main() -> int:
    """The process: serve the robot until standard input closes, and a little longer."""
    wanted = msgspec.json.decode(sys.argv[1], type=Wanted)
    address = None if wanted.ubisense is None else UdpAddress(*wanted.ubisense)
    chosen = RobotOptions(
        port=PtyPort(), tags=Tags(ubisense=address, name=tag_of(wanted.tag), errors=wanted.errors, seed=wanted.seed)
    )
    device = device_of(wanted.robot, chosen, wanted.pose)

    def ready(said: Any) -> None:
        sys.stdout.write(f"{json.dumps(dict(said))}\n")
        sys.stdout.flush()

    def truth() -> tuple[float, float, float, float]:
        x, y, yaw = device.pose or wanted.pose
        return x, y, 0.0, yaw

    with Rig(ready) as rig:
        rig.fit(chosen.tags)
        rig.serve(device, chosen)
        rig.start(chosen.tags, truth)
        while os.read(0, 1):
            pass
        time.sleep(SURVIVES_S)
    return 0
