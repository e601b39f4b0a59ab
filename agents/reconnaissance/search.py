"""Search of an area by a team: lanes over the own strip, and a map of target probabilities that is shared."""

from collections.abc import Mapping
from typing import Annotated, Any

import msgspec
import numpy as np

from vcmvsp.agents.avoidance.view import check_carried
from vcmvsp.agents.formation.aerial import GAIN, YAW_GAIN, check_flies
from vcmvsp.agents.reconnaissance.exchange import Kind, exchange
from vcmvsp.agents.reconnaissance.probability_map import Grid, Rectangle, Sensor
from vcmvsp.agents.reconnaissance.roster import Roster, members_of
from vcmvsp.agents.reconnaissance.search_map import SearchMap, of_picture, of_reading, swaths_m
from vcmvsp.agents.reconnaissance.sectors import Comb, LaneFollower, Point
from vcmvsp.agents.reconnaissance.watch import Watch, Watching
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.frames import wrap
from vcmvsp.cosim.types import Array, Looks, NonNegative, Positive, Probability, Velocity

Overlap = Annotated[float, msgspec.Meta(ge=0, lt=1)]
Some = Annotated[int, msgspec.Meta(ge=1)]

CAMERA = "camera"
MOST_CELLS = 1_000_000  # of a map; each contributor has one
CLIMB_M = 2.0  # at a larger deviation from its height it climbs or descends vertically
YAW_RATE = 1.0  # rad/s, at most, to hold the heading
SHOW_NS = seconds_to_ns(1.0)  # period of recorded maps
NOTHING: tuple[Array, Array] = (np.empty(0, np.intp), np.empty(0, bool))


class Search(Agent):
    """Search an area in a team: each member along the lanes of its own strip, with a shared map of target probabilities.

    The strips are divided among living members that search; the strip of a member that stops goes to the others. The
    vehicle flies level, at one heading. In a mission it continues to look and to share while another algorithm commands the
    vehicle, and resumes its lane afterwards. On its own it flies on after all targets are found, with ``status`` ``done``.

    Notes ``map_bytes``, payload bytes of all messages of the map so far, when it changes; on its own also ``found``,
    ``found_x`` and ``found_y``, when the map becomes sure of a target (of unknown name), and ``status``.

    Args:
        area: left, bottom, right, top, m, world.
        cell_m: side of a cell of the map, m.
        members: all members; default: all vehicles of the run, or of the mission.
        sectors: groups that share a strip; a mission sets its own; default: each member has one.
        exchange: protocol of the map: ``ledger``, ``consensus``, ``delta`` or ``none``.
        prior: probability of a target in a cell before the first look.
        p: probability of a detection in a cell with a target.
        q: probability of a detection in a cell without one.
        max_bytes: size of the largest message of the map, encoded.
        relay: of a ``ledger``: send and accept counts of third members.
        scaled: of ``consensus``: decide by the map times the number of members.
        sensor: ``camera``: recognition in pictures; or the name of a sensor of kind ``target_sensor``.
        watching: camera and targets; a mission sets its own.
        look_s: pictures within this time are one look, s: their errors are correlated.
        swath_m: visible width to either side of a lane, m; default: that of the camera.
        overlap: share of a lane's swath that the next lane covers again.
        speed: m/s.
        acceleration: m/s2, assumed for turns.
        height: m, world; default: that of the start.
        arrive_m: distance at which a way-point is reached.
        stuck_s: time without approach after which a way-point is skipped, s.
        share_s: time between messages of the map, s.
        most: messages of the map at a time, at most.
        targets: number of targets, for ``status``; default: unknown.
        alive_s: silence after which a member counts as lost, s; a mission sets its own.
        clock_bound_s: largest lead of other clocks, s; a mission sets its own.
    """

    roster: Roster | None = None
    watch: Watch | None = None
    _own_roster = False  # whether it created the roster itself

    def __init__(
        self,
        area: tuple[float, float, float, float],
        *,
        cell_m: Positive = 2.0,
        members: tuple[str, ...] = (),
        sectors: tuple[tuple[str, ...], ...] = (),
        exchange: Kind = "ledger",
        prior: Probability = 0.5,
        p: Probability = 0.9,
        q: Probability = 0.1,
        max_bytes: Some = 1400,
        relay: bool = True,
        scaled: bool = False,
        sensor: str = CAMERA,
        watching: Watching | None = None,
        look_s: NonNegative = 1.0,
        swath_m: Positive | None = None,
        overlap: Overlap = 0.2,
        speed: Positive = 4.0,
        acceleration: Positive = 2.0,
        height: float | None = None,
        arrive_m: Positive = 2.0,
        stuck_s: Positive = 6.0,
        share_s: Positive = 1.0,
        most: Some = 4,
        targets: Some | None = None,
        alive_s: Positive = 5.0,
        clock_bound_s: NonNegative = 0.0,
    ) -> None:
        self.grid = Grid(Rectangle(*area), cell_m)
        if self.grid.rows * self.grid.columns > MOST_CELLS:
            many = f"{self.grid.rows} x {self.grid.columns} cells of {cell_m:g} m"
            raise ScenarioError(f"{many} are too many (at most {MOST_CELLS}): use larger cells", key="cell_m")
        self._exchange: dict[str, Any] = {
            "grid": self.grid,
            "sensor": Sensor(p, q),
            "kind": exchange,
            "prior": prior,
            "max_bytes": max_bytes,
            "relay": relay,
            "scaled": scaled,
        }
        self._team: dict[str, Any] = {"sectors": sectors, "alive_s": alive_s, "clock_bound_s": clock_bound_s}
        self._flight: dict[str, Any] = {"speed": speed, "acceleration": acceleration, "stuck_s": stuck_s}
        self._lanes: dict[str, Any] = {"overlap": overlap, "reached": arrive_m}
        self.members, self.sensor, self.swath_m = members, sensor, swath_m
        self._own_watch = None if watching is None else Watch(watching)
        self.speed, self.height, self.most, self.targets = speed, height, most, targets
        self._look_ns, self._share_ns = seconds_to_ns(look_s), seconds_to_ns(share_s)
        if sensor != CAMERA:
            if swath_m is None:
                raise ScenarioError(f"is needed with the sensor {sensor!r}: set the width that it covers, m", key="swath_m")
            self.sensors = (sensor,)
        else:
            self.sensors = () if watching is None else (watching.camera,)

    @property
    def goal(self) -> Point | None:
        """Present way-point, m, world; None: none."""
        return None if self._way is None else self._way.goal

    def start(self, info: VehicleInfo) -> None:
        """Begin with an empty map."""
        check_flies(info)
        self._check_sensor(info)
        if self.roster is None or self._own_roster:
            self._own_roster, self.roster = True, Roster(info.name, members_of(info, self.members), **self._team)
        self._known_roster = roster = self.roster
        self.map = SearchMap(
            self.grid, exchange(**self._exchange, me=info.name, members=roster.members, clock_bound_s=roster.clock_bound_s)
        )
        self._way: LaneFollower | None = None
        self._hold: tuple[float, float] | None = None  # height and heading to fly at, m and rad
        self._now_ns: int | None = None  # of the last tick
        self._looked_ns: int | None = None  # time of the last picture that counted as a look
        self._agreed = False  # whether there was a look since the last messages
        self._share_at_ns = self._show_at_ns = 0
        self._bytes = 0
        self._found_places: list[Point] = []

    def facts(self, obs: Observation) -> Mapping[str, Any]:
        """Facts for the mission: whether the sector is shared, and the surest unclaimed place."""
        roster = self._tick(obs)
        claims = roster.claims(obs.clock_ns).values()
        likely, place = self.map.surest([*(claim.place for claim in claims), *roster.abandoned_places(obs.clock_ns)])
        return {"shared": roster.shared(obs.clock_ns), "probability": likely, "place": place}

    def act(self, obs: Observation, radio: Radio) -> Velocity:
        """Look, share, and fly on."""
        roster = self._tick(obs)
        self._share(obs, radio)
        if self._own_roster:
            roster.tell(obs, radio, "search", None)
        return self._fly(obs, roster)

    def stand_by(self, obs: Observation, radio: Radio) -> None:
        """Look and share while the vehicle does something else."""
        self._tick(obs)
        self._share(obs, radio)
        if self._way is not None:
            self._way.pause()

    def _tick(self, obs: Observation) -> Roster:
        """Update everything, once a tick, at the first call."""
        roster = self._known_roster
        if obs.clock_ns == self._now_ns:
            return roster
        self._now_ns = obs.clock_ns
        if self._hold is None:
            self._hold = self.height if self.height is not None else obs.state.position[2], obs.state.yaw
            if self.swath_m is not None:
                self._lay((self.swath_m, self.swath_m))
        if self._own_roster:
            roster.hear(obs)
        self.map.hear(obs)
        look = self._camera(obs) if self.sensor == CAMERA else self._detector(obs)
        if look is not None:
            self.map.look(*look, obs.clock_ns)
            self._agreed = True
        if self._own_roster or self.sensor != CAMERA:  # otherwise the tracker reports recognised targets
            self._note_found()
        if obs.clock_ns >= self._show_at_ns:
            self._show_at_ns = obs.clock_ns + SHOW_NS
            self.show(self.map.for_recording())
        return roster

    def _camera(self, obs: Observation) -> tuple[Array, Array] | None:
        """Cells of a picture that counts as a look, and those with a detection."""
        frame = None if self.watch is None else self.watch.look(obs)
        if frame is None or not frame.whole or frame.footprint is None:
            return None
        if self._way is None and self._hold is not None and (swaths := swaths_m(frame, self._hold[0])) is not None:
            self._lay(swaths)
        if self._looked_ns is not None and frame.time_ns - self._looked_ns < self._look_ns:
            return None
        self._looked_ns = frame.time_ns
        return of_picture(self.grid, frame)

    def _detector(self, obs: Observation) -> tuple[Array, Array] | None:
        looks = obs.readings.get(self.sensor)
        if looks is None:
            return None
        if not isinstance(looks, Looks):
            gives = f"gives a {type(looks).__name__}, not looks at cells"
            raise TypeError(f"sensor = {self.sensor!r} {gives}; name a sensor of kind target_sensor, or 'camera'")
        if looks.time_ns == self._looked_ns:
            return None
        self._looked_ns = looks.time_ns
        return of_reading(self.grid, looks)

    def _share(self, obs: Observation, radio: Radio) -> None:
        if obs.clock_ns < self._share_at_ns:
            return
        self._share_at_ns = obs.clock_ns + self._share_ns
        if not self._agreed:  # a consensus takes a step at each look; messages hold its result
            self.map.look(*NOTHING, obs.clock_ns)
        self._agreed = False
        frames_sent = sum(radio.send(body) for body in self.map.messages(obs.clock_ns, self.most))
        if frames_sent:
            self._bytes += frames_sent
            self.note(map_bytes=self._bytes)

    def _note_found(self) -> None:
        """Note a newly sure place; one at a tick."""
        new = next((blob for blob in self.map.blobs if not self.map.concerns(blob, self._found_places)), None)
        if new is None:
            return
        self._found_places.append(new.middle)
        self.note(found="", found_x=new.middle[0], found_y=new.middle[1])
        if len(self._found_places) == self.targets:
            self.note(status="done")

    def _fly(self, obs: Observation, roster: Roster) -> Velocity:
        """The command along the lanes, at the height and the heading to keep."""
        (x, y, z), (height, yaw) = obs.state.position, self._hold or (obs.state.position[2], obs.state.yaw)
        climb = max(-self.speed, min(GAIN * (height - z), self.speed))
        turn = max(-YAW_RATE, min(YAW_GAIN * wrap(yaw - obs.state.yaw), YAW_RATE))
        if self._way is None or abs(height - z) > CLIMB_M:
            vx, vy = 0.0, 0.0
            if self._way is not None:
                self._way.pause()
        else:
            vx, vy = self._way.velocity(obs.clock_ns, (x, y), roster.sectors(obs.clock_ns))
        return Velocity(linear=(vx, vy, climb), yaw_rate=turn)

    def _lay(self, swaths: Point) -> None:
        """Lay the lanes for visible distances along x and y, m; lanes across show what buildings hide."""

        def is_open(start: Point, end: Point) -> bool:
            return self.map.is_open(start, end, swaths[0] if start[0] == end[0] else swaths[1])

        across = swaths[1] if self.sensor == CAMERA else 0.0
        comb = Comb(self._known_roster.sector, self.grid.area, swaths[0], **self._lanes, across=across, is_open=is_open)
        self._way = LaneFollower(comb, **self._flight)

    def _check_sensor(self, info: VehicleInfo) -> None:
        if self.sensor == CAMERA:
            self.watch = self.watch or self._own_watch
            if self.watch is None:
                raise ValueError("sensor = 'camera' needs the camera and the targets: set watching = {...}")
            if self.watch is self._own_watch:
                self.watch.start(info)
        else:
            check_carried(info, self.sensor, "sensor")
