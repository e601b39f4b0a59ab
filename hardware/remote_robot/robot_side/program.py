"""Program on the robot's own computer: it waits for runs, and serves one after the other.

The robot moves only on commands of a run: it is stopped when the link ends, when no velocity comes for `DEADMAN_S`, when
velocities may be older than that, and when this program ends.
"""

import secrets
import signal
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.config import binding, registry
from vcmvsp.cosim.config.provenance import Source
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.transport import access_control, endpoints, key_names
from vcmvsp.cosim.types import Vec3
from vcmvsp.cosim.util.codec import encode
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import Driver, Sample, within
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import SAY_S, RobotHello, RobotOrder, RobotStatus, RobotWelcome
from vcmvsp.hardware.remote_robot.robot_side.connection import RunConnection, RunMessage, RunUnreachable
from vcmvsp.hardware.remote_robot.robot_side.watchdog import DriverWatchdog

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Bundle


POLL_S = 0.01  # period of reading samples
DIAL_S = 0.2  # between two attempts to connect
ASK_S = 0.5  # between two requests
DOOR_S = 3.0  # for the answer to the first request
SILENCE_S = 3.0  # without a message of the run the link counts as lost; the robot stands long before
KEEP_S = 10.0  # a driver stays open for a lost run
HANG_S = 3.0  # for a cycle, which takes about a millisecond
LINGER_S = 0.5  # for the last message to the run
LEFT = "the run is over"


class RobotProgram:
    """Implements ``vcmvsp robot``, with the arguments of `robot`.

    ``foreign`` says why the certificate does not match this vehicle; a run, if there is one, rejects it itself.
    """

    def __init__(
        self,
        vehicle: str,
        driver: Driver,
        endpoint: str,
        bundle: "Bundle | None",
        *,
        pose: Vec3 | None = None,
        foreign: str = "",
        tell: Callable[[str], None],
    ) -> None:
        self._vehicle, self._endpoint, self._bundle = vehicle, endpoint, bundle
        self._foreign, self._tell = foreign, tell
        self._watchdog = DriverWatchdog(driver, pose, tell)
        self._driver = driver
        self._robot = secrets.token_hex(8)
        self._last_text = ""
        self._ending = ""  # reason to end
        self._lost_ns: int | None = None  # start of the loss of a run
        self._echo = (0, 0, 0)  # newest order: number, its time, its arrival
        self._said_ns = 0

    def on_stop_signal(self, number: int, _frame: FrameType | None) -> None:
        """Signal handler; the second signal does not wait for the robot."""
        if self._ending:
            raise KeyboardInterrupt
        self._ending = f"ended by {signal.Signals(number).name}"

    def serve(self) -> None:
        """Run until a signal; the robot stands then, and its driver is closed."""
        try:
            while not self._ending:
                try:
                    connection = RunConnection(self._endpoint, self._bundle, self._vehicle)
                except RunUnreachable as nobody:
                    self._say_once(str(nobody))
                    if self._foreign:
                        raise UsageError(self._foreign) from None
                    self._rest(DIAL_S)
                    continue
                with closing(connection):
                    self._visit(connection)
        finally:
            self._watchdog.close(self._ending or "its program ends")
        self._tell(self._ending)

    def _visit(self, connection: RunConnection) -> None:
        welcome = self._greeted(connection)
        if welcome is None:
            return
        self._last_text, self._lost_ns = "", None
        self._echo = (0, 0, 0)
        watchdog = self._watchdog

        def say() -> str:
            self._say(connection)
            return ""

        try:
            if watchdog.run == welcome.run and watchdog.state == "open":
                self._tell("the run is back")
                watchdog.meet()
            else:
                self._tell(f"connected to a run ({self._endpoint})")
                watchdog.close("another run has connected", say)
                watchdog.open(welcome.run, welcome.start, lambda: self._reason_to_abort(connection))
            ended = self._drive(connection)
            watchdog.stop(ended if ended in (LEFT, self._ending) else f"the link to the run is lost ({ended})")
        except Exception as error:
            watchdog.fail(error, say)
            ended = ""
        if self._ending:
            watchdog.end(f"its program was {self._ending}", say)
            say()
        elif watchdog.failure is not None:
            self._say_last(connection, left=False)
        elif ended == LEFT:
            watchdog.close(LEFT, say)
            self._say_last(connection, left=True)
            self._tell(LEFT)
        else:
            self._lost_ns = time.monotonic_ns()
            self._tell(f"the link to the run is lost ({ended}); the robot stops")

    def _greeted(self, connection: RunConnection) -> RobotWelcome | None:
        """Request until the run accepts this robot; None: no answer, or the run ended."""
        driver = self._driver
        hello = RobotHello(
            protocol=messages.PROTOCOL,
            vehicle=self._vehicle,
            robot=self._robot,
            session=connection.id,
            device=driver.device,
            open_s=driver.open_deadline_s,
            close_s=driver.close_deadline_s,
        )
        until = time.monotonic() + DOOR_S
        while not self._ending:
            welcome = connection.greet(encode(hello))
            if welcome is not None and not welcome.refused:
                return welcome
            if welcome is not None:
                if welcome.final:
                    raise UsageError(f"the run rejects this robot: {plain(welcome.refused)}")
                self._say_once(f"waiting: {plain(welcome.refused)}")
            elif time.monotonic() > until:
                unknown = "what listens there does not answer robots: another vcmvsp version,"
                silence = unknown if self._bundle is None else f"{access_control.silence(self._bundle.name)};"
                self._say_once(f"{silence} or is {self._endpoint} not where the driver of {self._vehicle} listens?")
                self._rest(ASK_S)
                return None
            self._rest(ASK_S if welcome else DIAL_S)
            if connection.next(0.0) == "gone":
                return None
        return None

    def _reason_to_abort(self, connection: RunConnection) -> str:
        """Reason to abort the opening of the driver; sends the present status meanwhile."""
        self._say(connection)
        while (news := connection.next(0.0)) is not None:
            if news == "gone":
                return "the run has ended"
            order = self._decode_order(news)
            if order is not None and order.leave:
                return "the run is over"
        return self._ending

    def _drive(self, connection: RunConnection) -> str:
        watchdog = self._watchdog
        heard_ns = time.monotonic_ns()
        with within(HANG_S, self._driver.device, "a turn") as turned:
            while not self._ending and watchdog.failure is None:
                turned()
                news = connection.next(POLL_S)
                now_ns = time.monotonic_ns()
                if news == "gone":
                    return "the run has ended, or the network failed"
                if news is not None and (order := self._decode_order(news)) is not None:
                    heard_ns = now_ns
                    if order.leave:
                        return LEFT
                    watchdog.follow(order, now_ns)
                if now_ns > heard_ns + seconds_to_ns(SILENCE_S):
                    return f"no message was received for {SILENCE_S:g} s"
                sample = watchdog.turn(now_ns)
                if sample is not None or now_ns >= self._said_ns + seconds_to_ns(SAY_S):
                    self._say(connection, sample)
        return self._ending

    def _decode_order(self, news: "RunMessage | str") -> RobotOrder | None:
        """Decoded order of the run; None: invalid, or not newer than the last."""
        if isinstance(news, str):
            return None
        try:
            order = messages.downs.decode(news[0])
        except ValueError:
            self._say_once("the run sent an invalid message: use the same vcmvsp version on both machines")
            return None
        if order.number <= self._echo[0]:
            return None
        self._echo = order.number, order.sent_ns, news[1]
        return order

    def _say(self, connection: RunConnection, sample: Sample | None = None, *, left: bool = False) -> None:
        watchdog = self._watchdog
        number, sent_ns, heard_ns = self._echo
        self._said_ns = time.monotonic_ns()
        status = RobotStatus(
            said_ns=self._said_ns,
            heard=number,
            yours_ns=sent_ns,
            heard_ns=heard_ns,
            state=watchdog.state,
            opened=watchdog.opened,
            sample=sample,
            notices=watchdog.notices(),
            noticed=watchdog.noticed,
            failure=watchdog.failure,
            left=left,
        )
        connection.say(encode(status))

    def _say_last(self, connection: RunConnection, *, left: bool) -> None:
        """Send until the run has ended its link."""
        until = time.monotonic() + LINGER_S
        while time.monotonic() < until and not self._ending:
            self._say(connection, left=left)
            if connection.next(SAY_S) == "gone":
                return

    def _say_once(self, text: str) -> None:
        if text != self._last_text:
            self._last_text = text
            self._tell(text)

    def _rest(self, seconds: float) -> None:
        watchdog, until_ns = self._watchdog, time.monotonic_ns() + round(seconds * SECOND_NS)
        while not self._ending and (now_ns := time.monotonic_ns()) < until_ns:
            if watchdog.state == "open":
                try:
                    with within(HANG_S, self._driver.device, "a turn"):
                        watchdog.turn(now_ns)
                except Exception as error:
                    watchdog.fail(error)
                if self._lost_ns is not None and now_ns > self._lost_ns + seconds_to_ns(KEEP_S):
                    watchdog.close(f"its run is not back after {KEEP_S:g} s")
            time.sleep(min(DIAL_S, max(0.0, (until_ns - now_ns) / SECOND_NS)))


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
    """Serve runs until Ctrl-C or SIGTERM, as ``vcmvsp robot`` does.

    The driver is ``KIND`` or ``KIND:ADDRESS``; ``connect``: endpoint of the run's driver, e.g. ``tls/192.168.1.10:7448``;
    ``keys``: file with the certificate of this machine; the pose is x m, y m, yaw rad, None: as the run says.

    Raises:
        UsageError: an argument is invalid, or the run rejects this robot permanently.
        ScenarioError: the driver cannot be built.
    """
    try:
        key_names.robot_key(key_names.OPEN, vehicle, "0", "up")
    except ValueError:
        raise UsageError(f"--vehicle {vehicle!r}: a name has only letters, digits, _ and -") from None
    bundle, foreign = _bundle(keys, vehicle, tell)
    connect = endpoints.endpoint_rules(connect, bundle, insecure=insecure, side="robot")
    program = RobotProgram(vehicle, make_driver(driver, params or {}), connect, bundle, pose=pose, foreign=foreign, tell=tell)
    before = {each: signal.signal(each, program.on_stop_signal) for each in (signal.SIGINT, signal.SIGTERM)}
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


def make_driver(text: str, params: dict[str, Any]) -> Driver:
    """The driver of ``KIND`` or ``KIND:ADDRESS``, not open; `ScenarioError`: unknown kind, or invalid parameters."""
    kind, address = kind_of(text)
    origin = Source("--set")
    if kind == "zenoh":
        raise ScenarioError("zenoh is the run's side of this program: name the driver of the robot itself", source="--driver")
    driver_class = registry.find("driver", kind, key="", origin=Source("--driver"))
    if address:
        where = next((each for each in ADDRESSES if each in binding.parameters(driver_class)), None)
        if where is None:
            problem = f"'{kind}' has no address; leave ':{address}' out (set parameters by --set KEY=VALUE)"
            raise ScenarioError(problem, source="--driver")
        if where in params:
            raise ScenarioError(f"the address is given twice, as {where} and behind --driver {kind}:", source="--set")
        params = {where: address, **params}
    return binding.call(driver_class, params, origin=origin)


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
