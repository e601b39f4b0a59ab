"""Driver of vehicles with a MAVLink autopilot: multicopters, rovers and boats with PX4 or ArduPilot.

One thread uses the link: it finds the vehicle (`VehicleSearch`), sends messages of its `MavlinkSession`, and looks for a
lost vehicle. Everything shared with the caller is behind one lock, which is never held while waiting.

**Command authority.** The driver arms nothing and switches no mode, unless the scenario says so, and then once, on opening.
A pilot or a failsafe that switches the vehicle to another mode has the command from then on; the driver reports it, sends
zero speed, and follows commands again after the vehicle was switched back.
"""

import contextlib
import time
from typing import Annotated, Literal

import msgspec

from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.estimation.tangent_plane import TangentPlane
from vcmvsp.cosim.types import ORIGIN, NonNegative, Positive, Vec3, Velocity
from vcmvsp.hardware.drivers.base import COMMAND_TIMEOUT_S, CommandTimeout, HandshakeError, LinkLost, finite
from vcmvsp.hardware.drivers.byte_link import OPEN_S
from vcmvsp.hardware.drivers.mavlink.link import MavlinkLink, Peer, VehicleSearch, open_link
from vcmvsp.hardware.drivers.mavlink.protocol import Encoder, Sender, heartbeat, mavlink
from vcmvsp.hardware.drivers.mavlink.session import MavlinkSampler, MavlinkSession, SessionOptions
from vcmvsp.hardware.drivers.threaded import ReconnectingDriver

GOODBYE_S = 4.0  # heartbeats, which show a change of mode, come once a second
TAKEOFF_S = 30.0  # for a vehicle to reach its height

Baud = Annotated[int, msgspec.Meta(ge=1200, le=3_000_000)]
SystemId = Annotated[int, msgspec.Meta(ge=0, le=255)]
OwnId = Annotated[int, msgspec.Meta(ge=1, le=255)]
ConnectTime = Annotated[float, msgspec.Meta(gt=0, le=15)]  # s: with a take-off, less than a station allows its driver
TelemetryHz = Annotated[float, msgspec.Meta(ge=1, le=400)]


class MavlinkDriver(ReconnectingDriver):
    """A vehicle with an autopilot (`hardware.drivers.base.Driver`).

    Multicopters take a velocity in the world and a yaw rate; rovers and boats a forward speed and a yaw rate.

    Args:
        address: ``udpin:127.0.0.1:14540`` (wait for the vehicle there), ``udpout:HOST:PORT`` (send first), ``tcp:HOST:PORT``,
            or a serial port such as ``/dev/ttyACM0``.
        insecure: ``udpin:`` may be all interfaces, 0.0.0.0: any machine that reaches one can send as the vehicle.
        system_id: of the vehicle; 0: the only one at this address.
        own_id: id of this driver, different from that of any ground station in the network. PX4's data-link failsafe monitors
            it; ArduPilot's only if it is SYSID_MYGCS.
        baud: of a serial port.
        autopilot: ``auto``: from its heartbeat.
        switch_mode: switch to OFFBOARD or GUIDED on opening; otherwise the pilot switches.
        arm: arm the motors on opening; only with ``switch_mode``.
        takeoff_m: height of a take-off after arming, m; only with ``arm``.
        origin: autopilot's local origin in the world, m; or place of ``geodetic_origin``, if given.
        geodetic_origin: latitude and longitude (deg) and height (m above sea level, as in the autopilot): positions are then
            from GLOBAL_POSITION_INT; None: from LOCAL_POSITION_NED.
        telemetry_hz: requested rate of positions and attitudes.
        connect_s: to find the vehicle and to prepare it; a take-off has 30 s more.
        silence_s: without a position, the vehicle counts as lost.
        reconnect_s: time to look for a lost vehicle; 0: its loss is an error at once.
        command_timeout_s: without a command, the vehicle is stopped.
    """

    _who = "vehicle"
    _meanwhile = "the vehicle's own failsafe takes over"

    def __init__(
        self,
        *,
        address: str,
        insecure: bool = False,
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
            raise ScenarioError("arm = true needs switch_mode = true: this driver commands only in that mode", key="arm")
        if takeoff_m is not None and not arm:
            raise ScenarioError("takeoff_m needs arm = true: the driver lifts only vehicles that it has armed", key="takeoff_m")
        if system_id == own_id:
            raise ScenarioError(f"own_id must differ from system_id = {system_id}", key="own_id")
        try:
            self._plane = None if geodetic_origin is None else TangentPlane(*geodetic_origin)
        except ValueError as error:
            raise ScenarioError(str(error), key="geodetic_origin") from None
        super().__init__(
            address,
            open_deadline_s=OPEN_S + connect_s + (TAKEOFF_S if takeoff_m is not None else 0.0) + GOODBYE_S + 1.0,
            close_deadline_s=OPEN_S + GOODBYE_S + 1.0,
            connect_s=connect_s,
            silence_s=silence_s,
            reconnect_s=reconnect_s,
        )
        self.peer: Peer | None = None  # once it is connected
        self._system_id, self._baud, self._origin, self._insecure = system_id, baud, origin, insecure
        self._kind = None if autopilot == "auto" else autopilot
        self._encode = Encoder(Sender(system=own_id, component=mavlink.MAV_COMP_ID_MISSIONPLANNER))
        self._orders = SessionOptions(
            telemetry_hz=telemetry_hz, timeout_s=command_timeout_s, switch_mode=switch_mode, arm=arm, takeoff_m=takeoff_m
        )
        self._session: MavlinkSession | None = None  # None: not connected

    def write(self, velocity: Velocity) -> None:
        """Command a velocity; ignored while the vehicle is lost, not armed or under another command."""
        finite(velocity)
        with self._lock:
            self._check()
            if self._session is not None:
                self._session.command(velocity, time.monotonic_ns())

    def _prepare(self, start: Vec3) -> None:
        super()._prepare(start)
        self._sampler = MavlinkSampler(start, self._origin, self._plane)
        self.peer = None
        self._link: MavlinkLink | None = None

    def _hold(self, cause: str) -> bool:
        if self._session is not None:
            self._session.stop(cause)
        return False

    def _connect(self, within_s: float) -> None:
        """Open the link, find the vehicle and prepare it; a reconnection neither arms nor switches."""
        orders = self._orders
        if self._ready.is_set():
            orders = msgspec.structs.replace(orders, switch_mode=False, arm=False, takeoff_m=None)
        self._link = open_link(self.device, self._baud, insecure=self._insecure)
        began_ns = time.monotonic_ns()
        peer = self._find(self._link, began_ns + seconds_to_ns(within_s), within_s)
        self._link.answer(peer.source)
        session = MavlinkSession(peer, orders, self._sampler, time.monotonic_ns())
        if peer.on_ground and orders.takeoff_m is not None:
            raise HandshakeError(self.device, f"{peer.name} does not fly", "leave takeoff_m out")
        with self._lock:
            self.peer, self._session = peer, session
            self._sampler.connect()
        self._notice("connected", peer.name)
        more_s = TAKEOFF_S if orders.takeoff_m is not None else 0.0
        self._make_ready(session, peer.name, began_ns + seconds_to_ns(within_s + more_s))
        self._ready.set()

    def _find(self, link: MavlinkLink, deadline_ns: int, within_s: float) -> Peer:
        """Receive, and send a heartbeat once a second: some autopilots only answer."""
        system_id = self._system_id if self.peer is None else self.peer.sender.system  # only the lost vehicle counts
        search = VehicleSearch(self.device, system_id, self._kind)
        beat_ns = 0
        while (now_ns := time.monotonic_ns()) < deadline_ns:
            if now_ns >= beat_ns:
                beat_ns = now_ns + SECOND_NS
                link.write(self._encode(heartbeat()))
            if self._wait(link.fileno(), min(deadline_ns, beat_ns, search.due_ns)):
                peer = search.receive(link.read(), time.monotonic_ns())
            else:
                peer = search.decide(time.monotonic_ns())
            if peer is not None:
                return peer
        raise search.failure(within_s)

    def _make_ready(self, session: MavlinkSession, name: str, deadline_ns: int) -> None:
        while not session.ready:
            if session.interrupted:
                happened = f"{name} did not become ready: {session.interrupted}"
                raise HandshakeError(self.device, happened, "connect again when the vehicle is free")
            if time.monotonic_ns() >= deadline_ns:
                happened = f"{name} did not follow a request; waited for {session.waits_for}"
                raise HandshakeError(self.device, happened, "check its messages at the ground station, or raise connect_s")
            self._exchange(deadline_ns)

    def _converse(self) -> None:
        silence_ns = seconds_to_ns(self._silence_s)
        position_ns = message_ns = time.monotonic_ns()
        while True:
            messages, samples = self._exchange(position_ns + silence_ns)
            now_ns = time.monotonic_ns()
            position_ns = now_ns if samples else position_ns
            message_ns = now_ns if messages else message_ns
            if now_ns >= position_ns + silence_ns:
                problem, where = "no position was received", "its GPS or other positioning"
                if now_ns >= message_ns + silence_ns:
                    problem, where = "no message was received", "the vehicle's battery, cable and radio"
                raise LinkLost(self.device, f"{problem} for {self._silence_s:g} s", f"check {where}")

    def _exchange(self, until_ns: int) -> tuple[int, int]:
        """Send what is due, and receive until this time; number of messages and of samples."""
        link, session = self._link, self._session
        assert link is not None and session is not None  # noqa: PT018, S101  it is connected
        with self._lock:
            messages = session.advance(time.monotonic_ns())
            due_ns = session.due_ns
        if messages:
            link.write(self._encode(*messages))
        chunks = link.read() if self._wait(link.fileno(), min(due_ns, until_ns)) else []
        received = session.decode(chunks)  # without the lock: it takes its time for a burst of bytes
        with self._lock:
            now_ns = time.monotonic_ns()
            samples = [sample for each in received if (sample := session.receive(each, now_ns)) is not None]
            self._sample = samples[-1] if samples else self._sample
            news, session.news = session.news, []
        for what, cause in news:
            self._notice(what, cause)
        return len(received), len(samples)

    def _give_up(self) -> None:
        self._say_goodbye()  # a failed take-off ends in the air

    def _say_goodbye(self) -> None:
        """Zero speed and a mode that holds the position; set-points continue until the vehicle is in that mode.

        Only a vehicle on the ground is disarmed, if this driver armed it.
        """
        session = self._session
        if session is None or self._link is None:
            return
        self._leaving = True
        until_ns = time.monotonic_ns() + seconds_to_ns(GOODBYE_S)
        with self._lock:
            session.leave()
        try:
            while not session.ready and time.monotonic_ns() < until_ns:
                self._exchange(until_ns)
        except LinkLost:
            return  # it has gone by itself
        if not session.ready:
            self._notice("warned", f"the driver left the vehicle while waiting for {session.waits_for}: take over control")

    def _hang_up(self) -> None:
        """Release the port, with zero speed as the last message."""
        link, self._link = self._link, None
        with self._lock:
            session, self._session = self._session, None
        if link is None:
            return
        if session is not None:
            with contextlib.suppress(LinkLost):
                link.write(self._encode(*session.farewell()))
        link.close()
