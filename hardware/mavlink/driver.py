"""The driver of vehicles whose autopilot speaks MAVLink: multicopters, rovers and boats with PX4 or ArduPilot.

One thread owns the link: it finds the vehicle (`hello`), sends what `Pilot` says, and looks for the vehicle again. All that it
shares with the caller is behind one lock, which nobody holds while waiting.

**Who is in command.** The driver arms nothing and switches no mode, unless the scenario asks for it, and then once, while it
opens. Whoever switches the vehicle to another mode, a pilot or a failsafe, has it from then on; the driver says so, sends zero
speed, and follows commands again when it has been switched back.
"""

import contextlib
import os
import select
import threading
import time
from collections import deque
from typing import Annotated, Literal

import msgspec

from cosim.clock import SECOND_NS, seconds_to_ns
from cosim.errors import ScenarioError
from cosim.types import NonNegative, Positive, Vec3, Velocity
from hardware.driver import COMMAND_TIMEOUT_S, ORIGIN, CommandTimeout, DriverError, HandshakeError, LinkLost, Notice, Sample
from hardware.line import OPEN_S
from hardware.mavlink.codec import Encoder, Reader, Sender, mavlink, sender_of
from hardware.mavlink.hello import Peer, Search
from hardware.mavlink.link import Link, open_link
from hardware.mavlink.pilot import WHAT, Orders, Pilot, heartbeat
from hardware.mavlink.steering import finite
from hardware.mavlink.track import Track
from hardware.positioning.tangent_plane import TangentPlane

GOODBYE_S = 4.0  # heartbeats, which show that a mode was changed, come once a second
TAKEOFF_S = 30.0  # for a vehicle to reach its height
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 4.0  # before one attempt to connect again and the next: doubled each time
NOTICES = 1000  # kept for somebody who asks

Baud = Annotated[int, msgspec.Meta(ge=1200, le=3_000_000)]
SystemId = Annotated[int, msgspec.Meta(ge=0, le=255)]
OwnId = Annotated[int, msgspec.Meta(ge=1, le=255)]
ConnectTime = Annotated[float, msgspec.Meta(gt=0, le=15)]  # s: with a take-off, less than a station waits for its driver
TelemetryHz = Annotated[float, msgspec.Meta(ge=1, le=400)]


class _Closing(Exception):
    """The caller wants the thread to end."""


class MavlinkDriver:
    """A vehicle with an autopilot (`hardware.driver.Driver`).

    Multicopters take a velocity in the world and a yaw rate; rovers and boats a forward speed and a yaw rate.

    Args:
        address: ``udpin:0.0.0.0:14540`` (wait for the vehicle there), ``udpout:HOST:PORT`` (speak first), ``tcp:HOST:PORT``,
            or a serial port such as ``/dev/ttyACM0``.
        system_id: of the vehicle; 0: the only one that speaks there.
        own_id: ours, different from that of any ground station in the same network. PX4's data-link failsafe watches over it;
            ArduPilot's only if it is that of SYSID_MYGCS.
        baud: of a serial port.
        autopilot: ``auto``: as its heartbeat says.
        switch_mode: ask for OFFBOARD or GUIDED when it is opened; otherwise its pilot switches it.
        arm: start its motors when it is opened; only with ``switch_mode``.
        takeoff_m: rise by this when it was armed, m; only with ``arm``.
        origin: where the autopilot's local origin is in the world, m; where ``geodetic_origin`` is, if that is given.
        geodetic_origin: latitude and longitude (deg) and height (m above sea level, as the autopilot has it): positions are
            then taken from GLOBAL_POSITION_INT; None: from LOCAL_POSITION_NED.
        telemetry_hz: of positions and attitudes, asked of the vehicle.
        connect_s: to find the vehicle and to have it ready; a take-off has 30 s more.
        silence_s: without a position, the vehicle counts as lost.
        reconnect_s: for so long a vehicle that was lost is looked for; 0: losing it is an error at once.
        command_timeout_s: without a command, the vehicle is stopped.
    """

    def __init__(
        self,
        *,
        address: str,
        system_id: SystemId = 0,
        own_id: OwnId = 245,
        baud: Baud = 57_600,
        autopilot: Literal["auto", "px4", "ardupilot"] = "auto",
        switch_mode: bool = False,
        arm: bool = False,
        takeoff_m: Positive | None = None,
        origin: Vec3 = ORIGIN,
        geodetic_origin: Vec3 | None = None,
        telemetry_hz: TelemetryHz = 50.0,
        connect_s: ConnectTime = 10.0,
        silence_s: Positive = 2.0,
        reconnect_s: NonNegative = 0.0,
        command_timeout_s: CommandTimeout = COMMAND_TIMEOUT_S,
    ) -> None:
        if arm and not switch_mode:
            raise ScenarioError("arm = true needs switch_mode = true: in any other mode it would obey somebody else", key="arm")
        if takeoff_m is not None and not arm:
            raise ScenarioError("takeoff_m needs arm = true: only what the driver has armed does it let rise", key="takeoff_m")
        if system_id == own_id:
            raise ScenarioError(f"own_id must differ from system_id, which is {system_id} too", key="own_id")
        try:
            self._plane = None if geodetic_origin is None else TangentPlane(*geodetic_origin)
        except ValueError as error:
            raise ScenarioError(str(error), key="geodetic_origin") from None
        self.device = address
        self.open_deadline_s = OPEN_S + connect_s + (TAKEOFF_S if takeoff_m is not None else 0.0) + GOODBYE_S + 1.0
        self.close_deadline_s = OPEN_S + GOODBYE_S + 1.0
        self.peer: Peer | None = None  # once it is connected
        self._system_id, self._baud, self._origin = system_id, baud, origin
        self._kind = None if autopilot == "auto" else autopilot
        self._encode = Encoder(Sender(system=own_id, component=mavlink.MAV_COMP_ID_MISSIONPLANNER))
        self._orders = Orders(
            telemetry_hz=telemetry_hz, timeout_s=command_timeout_s, switch_mode=switch_mode, arm=arm, takeoff_m=takeoff_m
        )
        self._connect_s, self._silence_s, self._reconnect_s = connect_s, silence_s, reconnect_s
        self._thread: threading.Thread | None = None
        self._pilot: Pilot | None = None  # None: not connected
        self._lock = threading.Lock()
        self._notices: deque[Notice] = deque(maxlen=NOTICES)

    # What the caller does.

    def open(self, start: Vec3 = ORIGIN) -> None:
        """Connect; raises what is wrong. Odometry begins at ``start``; the state in the world is the autopilot's."""
        if self._thread is not None:
            raise RuntimeError(f"{self.device} is open already")
        self._track = Track(start, self._origin, self._plane)
        self.peer = None
        self._link: Link | None = None
        self._sample: Sample | None = None
        self._failure: DriverError | None = None
        self._closing, self._ready = threading.Event(), threading.Event()
        self._leaving = False
        self._woken, self._waker = os.pipe()
        self._thread = threading.Thread(target=self._run, name=f"vehicle at {self.device}", daemon=True)
        self._thread.start()
        self._ready.wait(self.open_deadline_s)
        if self._failure is not None or not self._ready.is_set():
            failure = self._failure or LinkLost(self.device, "the port hangs", "unplug it and plug it in again")
            self.close()
            raise failure

    def read(self) -> Sample | None:
        """The newest sample that was not read yet."""
        with self._lock:
            self._check()
            sample, self._sample = self._sample, None
        return sample

    def write(self, velocity: Velocity) -> None:
        """Command a velocity; while the vehicle is looked for, is not armed or is in somebody else's command, it is dropped."""
        finite(velocity)
        with self._lock:
            self._check()
            if self._pilot is not None:
                self._pilot.command(velocity, time.monotonic_ns())

    def stop(self, cause: str) -> None:
        """Zero speed at once; never raises."""
        with self._lock:
            if self._pilot is not None:
                self._pilot.stop(cause)
            self._notices.append(Notice(time_ns=time.monotonic_ns(), what="stopped", cause=cause))
        self._wake()

    def notices(self) -> list[Notice]:
        """What happened since the last call."""
        with self._lock:
            notices = list(self._notices)
            self._notices.clear()
        return notices

    def close(self) -> None:
        """Zero speed, and a mode in which it stays where it is; only what stands on the ground is disarmed, if we armed it."""
        thread = self._thread
        if thread is None:
            return
        self._closing.set()
        self._wake()
        thread.join(self.close_deadline_s)
        with self._lock:
            # One that is alive hangs in the operating system, and will end with the process.
            if self._thread is thread and not thread.is_alive():
                os.close(self._waker)
                os.close(self._woken)
                self._thread = None

    def _check(self) -> None:
        if self._thread is None:
            raise RuntimeError(f"{self.device} is not open")
        if self._failure is not None:
            raise self._failure

    def _wake(self) -> None:
        with self._lock:
            if self._thread is not None:
                os.write(self._waker, b"\0")

    # What the thread does.

    def _run(self) -> None:
        try:
            self._connect(self._orders, self._connect_s)
            while True:
                try:
                    self._converse()
                except LinkLost as lost:
                    self._let_go(lost)
                    self._look_for(lost)
        except _Closing:
            if not self._ready.is_set():
                self._failure = HandshakeError(self.device, "it was closed while it was being connected", "open it again")
            self._say_goodbye()
        except DriverError as error:
            self._failure = error
            self._say_goodbye()  # a failed take-off ends in the air
        except Exception as error:  # whatever it is: the caller must be told, and the vehicle stopped
            self._failure = DriverError(self.device, f"the driver failed ({type(error).__name__}: {error})", "report this")
        finally:
            self._hang_up()
            self._ready.set()

    def _connect(self, orders: Orders, within_s: float) -> None:
        """Open the link, find the vehicle and have it ready."""
        self._link = open_link(self.device, self._baud)
        began_ns = time.monotonic_ns()
        peer = self._find(self._link, began_ns + seconds_to_ns(within_s), within_s)
        self._link.answer(peer.source)
        self._reader = Reader()
        pilot = Pilot(peer, orders, self._track, time.monotonic_ns())
        if peer.on_ground and orders.takeoff_m is not None:
            raise HandshakeError(self.device, f"{peer.name} does not fly", "leave takeoff_m out")
        with self._lock:
            self.peer, self._pilot = peer, pilot
            self._track.connect()
        self._notice("connected", peer.name)
        more_s = TAKEOFF_S if orders.takeoff_m is not None else 0.0
        self._make_ready(pilot, began_ns + seconds_to_ns(within_s + more_s))
        self._ready.set()

    def _find(self, link: Link, deadline_ns: int, within_s: float) -> Peer:
        """Listen, with our own heartbeat once a second: some autopilots speak only when spoken to."""
        system_id = self._system_id if self.peer is None else self.peer.sender.system  # another is none that was lost
        search = Search(self.device, system_id, self._kind)
        beat_ns = 0
        while (now_ns := time.monotonic_ns()) < deadline_ns:
            if now_ns >= beat_ns:
                beat_ns = now_ns + SECOND_NS
                link.write(self._encode(heartbeat()))
            if self._wait(min(deadline_ns, beat_ns, search.due_ns)):
                peer = search.receive(link.read(), time.monotonic_ns())
            else:
                peer = search.decide(time.monotonic_ns())
            if peer is not None:
                return peer
        raise search.failure(within_s)

    def _make_ready(self, pilot: Pilot, deadline_ns: int) -> None:
        """Until it tells its position, and is in the mode, armed and as high as was asked for."""
        while not pilot.ready:
            if pilot.interrupted:
                happened = f"{self._name} was not made ready: {pilot.interrupted}"
                raise HandshakeError(self.device, happened, "open it again when it is free")
            if time.monotonic_ns() >= deadline_ns:
                happened = f"{self._name} did not do what was asked; waited for {pilot.waits_for}"
                raise HandshakeError(self.device, happened, "look at what its ground station says of it, or raise connect_s")
            self._exchange(deadline_ns)

    def _converse(self) -> None:
        """Read and send until the link is lost or the caller closes it."""
        silence_ns = seconds_to_ns(self._silence_s)
        heard_ns = spoke_ns = time.monotonic_ns()
        while True:
            messages, samples = self._exchange(heard_ns + silence_ns)
            now_ns = time.monotonic_ns()
            heard_ns = now_ns if samples else heard_ns
            spoke_ns = now_ns if messages else spoke_ns
            if now_ns >= heard_ns + silence_ns:
                silent = now_ns >= spoke_ns + silence_ns
                happened = (
                    f"nothing was heard for {self._silence_s:g} s"
                    if silent
                    else f"it told no position for {self._silence_s:g} s"
                )
                advice = (
                    "look at the vehicle's battery, its cable and its radio"
                    if silent
                    else "look at its GPS or other positioning"
                )
                raise LinkLost(self.device, happened, advice)

    def _exchange(self, until_ns: int) -> tuple[int, int]:
        """Send what is due, wait for what comes, until this time; how many messages and samples there were."""
        link, pilot = self._link, self._pilot
        assert link is not None  # noqa: S101  it is connected
        assert pilot is not None  # noqa: S101  the same
        with self._lock:
            messages = pilot.advance(time.monotonic_ns())
            due_ns = pilot.due_ns
        if messages:
            link.write(self._encode(*messages))
        heard = samples = 0
        if self._wait(min(due_ns, until_ns)):
            for _, data in link.read():
                for message in self._reader.feed(data):
                    if sender_of(message) == self._peer_sender:
                        heard += 1
                        with self._lock:
                            sample = pilot.receive(message, time.monotonic_ns())
                            self._sample = sample or self._sample
                        samples += sample is not None
        self._tell(pilot)
        return heard, samples

    def _tell(self, pilot: Pilot) -> None:
        with self._lock:
            news, pilot.news = pilot.news, []
        for what, cause in news:
            self._notice(what, cause)

    @property
    def _peer_sender(self) -> Sender:
        assert self.peer is not None  # noqa: S101  it is connected
        return self.peer.sender

    @property
    def _name(self) -> str:
        return self.peer.name if self.peer is not None else "the vehicle"

    def _let_go(self, lost: LinkLost) -> None:
        """Note the loss; a vehicle that still hears us stops now, any other by its own failsafe."""
        self._notice("lost", f"{lost.happened}; the vehicle's own failsafe takes over")
        self._hang_up()

    def _look_for(self, lost: LinkLost) -> None:
        """Connect again, after longer and longer pauses; without arming or switching anything."""
        orders = msgspec.structs.replace(self._orders, switch_mode=False, arm=False, takeoff_m=None)
        deadline_ns = time.monotonic_ns() + seconds_to_ns(self._reconnect_s)
        pause_s, last = FIRST_PAUSE_S, ""
        while (now_ns := time.monotonic_ns()) < deadline_ns:
            self._pause(min(deadline_ns, now_ns + seconds_to_ns(pause_s)))
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)
            left_s = (deadline_ns - time.monotonic_ns()) / SECOND_NS
            try:
                return self._connect(orders, max(0.0, min(self._connect_s, left_s)))
            except DriverError as error:
                last = error.happened
                self._hang_up()
        if not self._reconnect_s:
            raise lost
        happened = f"{lost.happened}, and it was not back within {self._reconnect_s:g} s ({last})"
        raise LinkLost(self.device, happened, lost.advice)

    def _say_goodbye(self) -> None:
        """Zero speed and a mode in which it holds its place; set-points go on until it is in that mode."""
        pilot = self._pilot
        if pilot is None or self._link is None:
            return
        self._leaving = True
        until_ns = time.monotonic_ns() + seconds_to_ns(GOODBYE_S)
        with self._lock:
            pilot.leave()
        try:
            while not pilot.ready and time.monotonic_ns() < until_ns:
                self._exchange(until_ns)
        except LinkLost:
            return  # it has gone by itself
        if not pilot.ready:
            self._notice("warned", f"it was left while we waited for {pilot.waits_for}: take it over")

    def _hang_up(self) -> None:
        """Free the port, with zero speed as the last words to whoever still listens."""
        link, self._link = self._link, None
        with self._lock:
            pilot, self._pilot = self._pilot, None
        if link is None:
            return
        if pilot is not None:
            with contextlib.suppress(LinkLost):
                link.write(self._encode(*pilot.farewell()))
        link.close()

    def _wait(self, until_ns: int) -> bool:
        """Wait for bytes, for the caller, or until this time; whether there are bytes."""
        assert self._link is not None  # noqa: S101  only called with a link
        return self._link.fileno() in self._select([self._link.fileno()], until_ns)

    def _pause(self, until_ns: int) -> None:
        while time.monotonic_ns() < until_ns:
            self._select([], until_ns)

    def _select(self, files: list[int], until_ns: int) -> list[int]:
        left_s = max(0.0, (until_ns - time.monotonic_ns()) / SECOND_NS)
        ready, _, _ = select.select([self._woken, *files], [], [], left_s)
        if self._woken in ready:
            os.read(self._woken, 4096)
        if self._closing.is_set() and not self._leaving:
            raise _Closing
        return ready

    def _notice(self, what: WHAT, cause: str) -> None:
        with self._lock:
            self._notices.append(Notice(time_ns=time.monotonic_ns(), what=what, cause=cause))
