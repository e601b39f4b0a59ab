"""Driver of robots that run ``vcmvsp robot`` on their own computer, over Eclipse Zenoh, and admission of robots.

The driver listens and the robot connects, so that only the run's machine needs a known address and an open port. One thread
sends `CommandState` and receives; everything shared with the caller is behind one lock, which is never held while waiting.
Beyond this machine both ends need certificates; without one for this vehicle a robot can only send its request.
"""

import contextlib
import queue
import re
import secrets
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError, UsageError
from vcmvsp.cosim.transport import access_control, endpoints, key_names
from vcmvsp.cosim.types import NonNegative, Positive, Vec3
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, DriverError, HandshakeError, LinkLost, PortError
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import SAY_S, RobotHello, RobotWelcome
from vcmvsp.hardware.remote_robot.run_side.listener import LinkEnded, Peer, RobotGreeting, RobotListener, RobotMessage
from vcmvsp.hardware.remote_robot.run_side.session import RobotSession

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys


RELOAD_S = 1.0  # certificates are read at most once in this time


class Admission:
    """Admits robots of one vehicle; without the folder of an authority any robot may come."""

    def __init__(self, vehicle: str, folder: Path | None) -> None:
        self._vehicle, self._folder = vehicle, folder
        self._current: tuple[float, Keys] | None = None  # time of reading, and the certificates

    def keys(self) -> "Keys | None":
        """Present certificates, at most `RELOAD_S` old: one may be revoked while the driver listens.

        `UsageError`: they cannot be read.
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


START_S = 5.0  # for the session
INVITE_S = 2.0  # before a message to the user


class ZenohDriver(RobotSession):
    """A robot with ``vcmvsp robot`` on its own computer (`hardware.drivers.base.Driver`).

    Args:
        listen: endpoint for the robot, such as ``tls/0.0.0.0:7448``; each vehicle has a port of its own.
        keys: folder of the authority ('vcmvsp keys init'), relative to the scenario's; required beyond this machine.
        insecure: allow connections without certificates.
        open_deadline_s: for the robot to connect and to be ready.
        silence_s: without a message from the robot, it counts as lost.
        reconnect_s: waiting time for a lost robot; 0: its loss is an error at once.
        command_timeout_s: without a command, the robot is stopped.
        vehicle: vehicle of the robot; given by the run.
        folder: of the scenario; given by the run.
    """

    def __init__(
        self,
        *,
        listen: str,
        keys: str = "",
        insecure: bool = False,
        open_deadline_s: Positive = 45.0,
        silence_s: Positive = 1.0,
        reconnect_s: NonNegative = 0.0,
        command_timeout_s: CommandTimeout = COMMAND_TIMEOUT_S,
        vehicle: str = "",
        folder: str = "",
    ) -> None:
        if vehicle and not re.fullmatch(r"[A-Za-z0-9_-]+", vehicle):
            raise ScenarioError(f"must have letters, digits, _ and - only, not {vehicle!r}", key="vehicle")
        try:
            if keys and insecure:
                raise UsageError("keys and insecure exclude one another: leave one of them out")
            listen = endpoints.endpoint_rules(listen, keys or None, insecure=insecure, side="driver")
        except UsageError as error:
            raise ScenarioError(str(error), key="listen") from None
        super().__init__(
            f"{listen} ({vehicle})" if vehicle else listen,
            vehicle=vehicle,
            open_deadline_s=START_S + open_deadline_s,
            reconnect_s=reconnect_s,
            command_timeout_s=command_timeout_s,
        )
        self._listen, self._secure = listen, bool(keys)
        self._admission = Admission(vehicle, Path(folder, keys) if keys else None)
        self._open_s, self._silence_s, self._silence_ns = open_deadline_s, silence_s, seconds_to_ns(silence_s)

    @property
    def invitation(self) -> str:
        """Command line that starts the robot's program."""
        keys = f"--keys {self._vehicle}.keys" if self._secure else "--insecure"
        with contextlib.suppress(UsageError):  # reported on opening
            if (certified := self._admission.keys()) is not None:
                keys = f"--keys {certified.file_of(self._vehicle)}"
        where = re.sub(r"/(0\.0\.0\.0|\[::\]):", "/HOST:", self._listen)
        return f"vcmvsp robot --vehicle {self._vehicle} --driver KIND:ADDRESS --connect {where} {keys}"

    def _prepare(self, start: Vec3) -> None:
        if not self._vehicle:
            raise HandshakeError(self.device, "it was not told whose robot is to come", "give it a vehicle")
        super()._prepare(start)
        self._run_name = secrets.token_hex(8)
        self._invited = False  # the user was informed
        self._refused = ""  # reason of the last rejection

    def _work(self) -> None:
        with contextlib.closing(RobotListener(self._listen, self._authority(), self._vehicle, self._hand_over)) as listener:
            self._listener = listener
            try:
                self._converse(time.monotonic_ns() + seconds_to_ns(self._open_s))
            except DriverError as error:
                self._failure = error
                self._ready.set()
            self._say_goodbye()

    def _authority(self) -> "Keys | None":
        try:
            keys = self._admission.keys()
            if keys is not None and (warning := keys.check()):
                self._notice("warned", warning)
        except UsageError as error:
            raise PortError(self.device, str(error), "name the folder of the authority, keys = 'DIR'") from None
        return keys

    def _converse(self, open_until_ns: int) -> None:
        due_ns = 0
        while not self._closing.is_set():
            now_ns = time.monotonic_ns()
            if now_ns >= due_ns:
                self._say()
                due_ns = now_ns + seconds_to_ns(SAY_S)
            self._watch(now_ns, open_until_ns)
            try:
                news = self._news.get(timeout=max(0.0, (due_ns - now_ns) / SECOND_NS))
            except queue.Empty:
                continue
            if news is None:
                self._woken.clear()
                due_ns = 0
            elif isinstance(news, RobotGreeting):
                self._greeted(news)
            elif isinstance(news, LinkEnded) and news.peer == self._peer:
                self._let_go("the robot's program has ended, or its link broke")
            elif isinstance(news, RobotMessage) and news.peer == self._peer:
                self._heard(news)
        if not self._ready.is_set():
            raise HandshakeError(self.device, "it was closed while its robot was waited for", "open it again")

    def _watch(self, now_ns: int, open_until_ns: int) -> None:
        if self._peer is not None and now_ns >= self._heard_ns + self._silence_ns:
            self._let_go(f"nothing was heard for {self._silence_s:g} s")
        if not self._ready.is_set():
            if now_ns >= open_until_ns:
                raise self._nobody()
            if self._peer is None and not self._invited and now_ns >= open_until_ns - seconds_to_ns(self._open_s - INVITE_S):
                self._invited = True
                sys.stderr.write(f"waiting for the robot of {self._vehicle} at {self._listen}; there: {self.invitation}\n")
                sys.stderr.flush()
        elif self._lost is not None and now_ns >= self._lost_ns + seconds_to_ns(self._reconnect_s):
            lost, back = self._lost, f"and it was not back within {self._reconnect_s:g} s"
            raise LinkLost(self.device, f"{lost.happened}, {back}", lost.advice) if self._reconnect_s else lost

    def _greeted(self, greeting: RobotGreeting) -> None:
        try:
            hello = messages.hellos.decode(greeting.payload)
            peer = Peer(greeting.name, hello.session)
            key_names.robot_key(peer.name, self._vehicle, peer.session, "up")
        except ValueError:
            greeting.answer(RobotWelcome(refused="that was no greeting of a robot of this version", final=True))
            return
        final = self._admission.refusal(greeting.name, hello)
        if refused := final or self._waits(greeting.name, hello):
            self._refused = refused
            self._warn_once(f"a robot was sent away: {refused}")
            greeting.answer(RobotWelcome(refused=refused, final=bool(final)))
            return
        if self._peer is not None and self._peer != peer:
            self._let_go("the robot has dialled anew")
        if self._peer is None:
            self._follow(peer, hello)
        greeting.answer(RobotWelcome(run=self._run_name, start=self._sampler.pose))

    def _waits(self, name: str, hello: RobotHello) -> str:
        """Reason not to accept an admitted robot now; empty: accept it."""
        hello_before = self._hello
        if self._closing.is_set():
            return "the run is over"
        if self._peer is not None and hello_before is not None and (self._peer.name, hello_before.robot) != (name, hello.robot):
            return f"another program drives {self._vehicle} already"
        return ""

    def _nobody(self) -> HandshakeError:
        within = f"within {self._open_s:g} s"
        if self._peer is not None and self._hello is not None:
            happened = f"the robot has come, but its own driver ({plain(self._hello.device)}) is not open {within}"
            advice = f"look at the robot; it may take {self._hello.open_s:g} s: open_deadline_s"
            return HandshakeError(self.device, happened, advice)
        refusal = f"; one was sent away: {self._refused}" if self._refused else ""
        happened = f"the robot of {self._vehicle} did not come {within}{refusal}"
        return HandshakeError(self.device, happened, f"start on its own computer: {self.invitation}")
