"""Driver of robots that run ``vcmvsp robot`` on their own computer, over Eclipse Zenoh.

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
from vcmvsp.cosim.transport import endpoints, key_names
from vcmvsp.cosim.types import NonNegative, Positive, Vec3
from vcmvsp.cosim.util.text import plain
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, DriverError, HandshakeError, LinkLost, PortError
from vcmvsp.hardware.remote_robot import messages
from vcmvsp.hardware.remote_robot.messages import SAY_S, RobotHello, RobotWelcome
from vcmvsp.hardware.remote_robot.run_side.admission import Admission
from vcmvsp.hardware.remote_robot.run_side.listener import LinkEnded, News, Peer, RobotGreeting, RobotListener
from vcmvsp.hardware.remote_robot.run_side.session import RobotSession

if TYPE_CHECKING:
    from vcmvsp.cosim.security.certificates import Keys

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
            listen = _check(listen, keys, insecure=insecure)
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

    # What the caller does.

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

    # What the thread does.

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
        """Receive and send until the caller closes it."""
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
            else:
                self._take(news)
        if not self._ready.is_set():
            raise HandshakeError(self.device, "it was closed while its robot was waited for", "open it again")

    def _take(self, news: News) -> None:
        if isinstance(news, RobotGreeting):
            self._greeted(news)
        elif news.peer == self._peer:
            if isinstance(news, LinkEnded):
                self._let_go("the robot's program has ended, or its link broke")
            else:
                self._heard(news)

    def _watch(self, now_ns: int, open_until_ns: int) -> None:
        """Detect silence and missed deadlines."""
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
            raise self._gone_for_good(self._lost)

    # Greetings

    def _greeted(self, greeting: RobotGreeting) -> None:
        """Accept a robot, or answer why not."""
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

    # Errors of a missing robot

    def _nobody(self) -> HandshakeError:
        """Why no robot is ready."""
        within = f"within {self._open_s:g} s"
        if self._peer is not None and self._hello is not None:
            happened = f"the robot has come, but its own driver ({plain(self._hello.device)}) is not open {within}"
            return HandshakeError(
                self.device, happened, f"look at the robot; it may take {self._hello.open_s:g} s: open_deadline_s"
            )
        refusal = f"; one was sent away: {self._refused}" if self._refused else ""
        happened = f"the robot of {self._vehicle} did not come {within}{refusal}"
        return HandshakeError(self.device, happened, f"start on its own computer: {self.invitation}")

    def _gone_for_good(self, lost: LinkLost) -> LinkLost:
        if not self._reconnect_s:
            return lost
        return LinkLost(self.device, f"{lost.happened}, and it was not back within {self._reconnect_s:g} s", lost.advice)


def _check(listen: str, keys: str, *, insecure: bool) -> str:
    """Endpoint after its checks; the keys themselves are read on opening."""
    if keys and insecure:
        raise UsageError("keys and insecure exclude one another: leave one of them out")
    return endpoints.endpoint_rules(listen, keys or None, insecure=insecure, side="driver")
