"""Arguments of ``vcmvsp robot`` become a driver, a certificate and a `RobotProgram`."""

import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.transport import endpoints, key_names
from vcmvsp.cosim.types import Vec3
from vcmvsp.hardware.drivers.base import Driver
from vcmvsp.hardware.remote_robot.robot_side.program import RobotProgram

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle

ADDRESSES = ("port", "address", "endpoint")
"""Parameters of drivers that say where a robot is."""


def robot(
    vehicle: str,
    driver: str,
    connect: str,
    *,
    params: dict[str, Any] | None = None,
    keys: Path | None = None,
    insecure: bool = False,
    pose: Vec3 | None = None,
    tell: Callable[[str], None],
) -> None:
    """Serve runs until Ctrl-C or SIGTERM.

    Args:
        vehicle: vehicle of this robot.
        driver: ``KIND`` or ``KIND:ADDRESS``.
        connect: endpoint of the run's driver, e.g. ``tls/192.168.1.10:7448``.
        params: parameters of the driver.
        keys: file with the certificate of this machine.
        insecure: connect to another machine without certificate.
        pose: pose of the robot (x m, y m, yaw rad); None: as the run says.
        tell: takes lines for the user.

    Raises:
        UsageError: an argument is invalid, or the run rejects this robot permanently.
        ScenarioError: the driver cannot be built.
    """
    try:
        key_names.robot_key(key_names.OPEN, vehicle, "0", "up")
    except ValueError:
        raise UsageError(f"--vehicle {vehicle!r}: a name has letters, digits, _ and -") from None
    bundle, foreign = _bundle(keys, vehicle, tell)
    connect = endpoints.endpoint_rules(connect, bundle, insecure=insecure, side="robot")
    program = RobotProgram(vehicle, built(driver, params or {}), connect, bundle, pose=pose, foreign=foreign, tell=tell)
    before = {each: signal.signal(each, program.told_to_end) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        program.serve()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _bundle(keys: Path | None, vehicle: str, tell: Callable[[str], None]) -> "tuple[Bundle | None, str]":
    """The certificate, and why it does not match this vehicle; empty: it does."""
    if keys is None:
        return None, ""
    from vcmvsp.cosim.security import certificates

    bundle = certificates.load_bundle(keys)
    if warning := bundle.check():
        tell(warning)
    bundle.speaks_for(())  # it is for vehicles
    try:
        bundle.speaks_for([vehicle])
    except UsageError as error:
        return bundle, str(error)
    return bundle, ""


def built(text: str, params: dict[str, Any]) -> Driver:
    """The driver of ``KIND`` or ``KIND:ADDRESS`` and its parameters, not open.

    Raises:
        ScenarioError: unknown kind, or invalid parameters.
    """
    kind, address = kind_of(text)
    origin = Source("--set")
    if kind == "zenoh":
        raise ScenarioError("zenoh is the run's end of this program: name the driver of the robot itself", source="--driver")
    driver_class = registry.find("driver", kind, key="", origin=Source("--driver"))
    if address:
        where = next((each for each in ADDRESSES if each in binding.parameters(driver_class)), None)
        if where is None:
            problem = f"'{kind}' takes no address; leave ':{address}' out (parameters come by --set KEY=VALUE)"
            raise ScenarioError(problem, source="--driver")
        if where in params:
            raise ScenarioError(f"the address is there twice, as {where} and behind --driver {kind}:", source="--set")
        params = {where: address, **params}
    driver: Driver = binding.call(driver_class, params, origin=origin)
    return driver


def kind_of(text: str) -> tuple[str, str]:
    """Kind and address: ``arcos:/dev/ttyUSB0``, ``bench``, ``my_robot.py:Rover:/dev/ttyUSB0``."""
    head, _, rest = text.partition(":")
    name, _, address = rest.partition(":")
    try:
        registry.target("driver", head)
    except ScenarioError:
        if name.isidentifier():
            return f"{head}:{name}", address
    return head, rest
