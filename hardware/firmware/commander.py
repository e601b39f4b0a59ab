"""Passes commands of an agent to firmware as the driver of real autopilots does: MAVLink set-points, in simulated time.

It switches the mode, arms and takes off (`hardware.drivers.mavlink.session`), then repeats the newest velocity. A way-point
becomes a velocity towards it from the position that the firmware estimates.
"""

import math
from collections.abc import Iterator

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Vec3, VehicleState, Velocity, Waypoint
from vcmvsp.cosim.util.polling import readable
from vcmvsp.hardware.drivers.base import What
from vcmvsp.hardware.drivers.mavlink.link import MavlinkLink, VehicleSearch, open_link
from vcmvsp.hardware.drivers.mavlink.protocol import Encoder, Sender, heartbeat, mavlink
from vcmvsp.hardware.drivers.mavlink.session import MavlinkSampler, MavlinkSession, SessionOptions
from vcmvsp.hardware.firmware.link import FirmwareLink

LOOK_NS = 10_000_000  # between two looks at the link
REPEAT_NS = 100_000_000  # between two commands to the session, whose commands expire
TELEMETRY_HZ = 20.0
READY_NS = 60 * SECOND_NS  # after which a firmware that is not ready is reported
GAIN, SPEED_MPS = 0.8, 3.0  # 1/s and m/s, towards a way-point; the former as of the simulated quadrotor's own autopilot
BAUD = 57_600  # of a serial port
OWN_ID = 245  # as of the driver


class MavlinkCommander:
    """Commands one firmware over its MAVLink port."""

    def __init__(self, firmware: FirmwareLink) -> None:
        self._firmware = firmware
        self._command: Velocity | Waypoint = Velocity()
        self._link: MavlinkLink | None = None
        self._session: MavlinkSession | None = None
        self._encode = Encoder(Sender(system=OWN_ID, component=mavlink.MAV_COMP_ID_MISSIONPLANNER))
        self._look_ns = self._beat_ns = self._repeat_ns = 0
        self._late_ns: int | None = None

    def command(self, command: Velocity | Waypoint) -> None:
        """Set the newest command."""
        self._command = command

    def advance(self, now_ns: int) -> Iterator[tuple[What, str]]:
        """Exchange messages; yields notices.

        Raises:
            DriverError: the port cannot be opened, or the connection is lost.
        """
        if now_ns < self._look_ns:
            return
        self._look_ns = now_ns + LOOK_NS
        if self._link is None:
            self._open(now_ns)
        if self._session is None:
            self._search(now_ns)
        else:
            self._converse(self._session, now_ns)
        yield from self._notices(now_ns)

    def close(self) -> None:
        """Close the port. Repeated calls are allowed."""
        if self._link is not None:
            self._link.close()
            self._link = None

    def _open(self, now_ns: int) -> None:
        self._link = open_link(self._firmware.mavlink, BAUD)
        self._search_for = VehicleSearch(self._firmware.mavlink, 0, None)
        self._sampler = MavlinkSampler((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), self._firmware.plane)
        self._late_ns = now_ns + READY_NS

    def _chunks(self) -> list[tuple[str, bytes]]:
        assert self._link is not None  # noqa: S101  it is open
        return self._link.read() if readable([self._link.fileno()], 0.0) else []

    def _write(self, data: bytes) -> None:
        assert self._link is not None  # noqa: S101  it is open
        self._link.write(data)

    def _search(self, now_ns: int) -> None:
        if now_ns >= self._beat_ns:
            self._beat_ns = now_ns + SECOND_NS
            self._write(self._encode(heartbeat()))
        peer = self._search_for.receive(self._chunks(), now_ns)
        if peer is not None and self._link is not None:
            self._link.answer(peer.source)
            orders = SessionOptions(
                telemetry_hz=TELEMETRY_HZ, timeout_s=1.0, switch_mode=True, arm=True, takeoff_m=self._firmware.takeoff_m
            )
            self._sampler.connect()
            self._session = MavlinkSession(peer, orders, self._sampler, now_ns)

    def _converse(self, session: MavlinkSession, now_ns: int) -> None:
        for message in session.decode(self._chunks()):
            session.receive(message, now_ns)
        if session.ready and now_ns >= self._repeat_ns:
            self._repeat_ns = now_ns + REPEAT_NS
            session.command(towards(self._command, self._sampler.state), now_ns)
        if messages := session.advance(now_ns):
            self._write(self._encode(*messages))

    def _notices(self, now_ns: int) -> Iterator[tuple[What, str]]:
        if self._session is not None:
            news, self._session.news = self._session.news, []
            yield from news
        if self._late_ns is not None and now_ns >= self._late_ns:
            self._late_ns = None
            if self._session is None:
                yield "warned", f"no heartbeat of its firmware came to {self._firmware.mavlink}"
            elif not self._session.ready:
                yield "warned", f"its firmware does not follow commands; waited for {self._session.waits_for}"


def towards(command: Velocity | Waypoint, state: VehicleState | None) -> Velocity:
    """A velocity, or that towards a way-point, from a state that may be unknown yet."""
    if isinstance(command, Velocity):
        return command
    if state is None:
        return Velocity()
    way = [to - at for to, at in zip(command.position, state.position, strict=True)]
    most = SPEED_MPS if command.speed is None else command.speed
    share = min(GAIN, most / max(math.hypot(*way), 1e-9))
    linear: Vec3 = (share * way[0], share * way[1], share * way[2])
    turn = 0.0 if command.yaw is None else GAIN * math.remainder(command.yaw - state.yaw, math.tau)
    return Velocity(linear=linear, yaw_rate=turn)
