"""Agent that recognises targets with its camera, and tracks one of them from above."""

import math
from collections.abc import Mapping
from functools import partial
from typing import Annotated, Any

import msgspec

from vcmvsp.agents.formation.aerial import check_flies
from vcmvsp.agents.reconnaissance.picture_recording import Mosaicking, PictureRecording, Sheet
from vcmvsp.agents.reconnaissance.roster import Claim, Roster, members_of
from vcmvsp.agents.reconnaissance.tracking import GAIN, LOST_S, SMOOTHING, SPIRAL_S, WITHIN_M, Confirmation, Point, Tracker
from vcmvsp.agents.reconnaissance.watch import GroundDisc, Watch, WatchFrame, Watching
from vcmvsp.cosim.agent import Agent, Observation, Radio, VehicleInfo
from vcmvsp.cosim.clock import seconds_to_ns
from vcmvsp.cosim.errors import ScenarioError
from vcmvsp.cosim.types import Positive, Probability, Velocity, Waypoint

AT_LEAST_ONE = Annotated[int, msgspec.Meta(ge=1, le=1000)]

CLIMB = 1.0  # m/s, at most
WHOLE_NS = seconds_to_ns(1.0)  # period of pictures that are examined entirely, also while tracking
DETOUR = 2.0  # times the straight way: longest time to the reported place of a target


class TrackTarget(Agent):
    """Search for targets, and stay above a recognised one.

    On its own it hovers until an unclaimed target is confirmed, tracks it, and hovers again after losing it or after
    another vehicle claims it. In a mission `begin` and `end` start and stop tracking.

    While the target is visible, only the ground around it is examined, except in one picture a second: other targets are still
    reported, and recognition costs a third.

    A target that is known from a map alone may be far away. It counts as visible until the vehicle can be there, at most
    for twice the time of the straight way.

    Notes ``target``, the tracked one (empty: none, or unknown), when it changes; ``found``, ``found_x`` and ``found_y``, m,
    once for each target that it confirms before another vehicle tracks it.

    Args:
        watching: camera and targets; a mission sets its own.
        members: on its own: members that exchange claims; default: all vehicles of the run.
        gain: 1/s, speed towards the target for each metre of offset.
        smoothing: share of a new measurement in the estimated velocity of the target, a tick; 0: the target is at rest.
        max_speed: m/s.
        height: m, world, while tracking; default: that of the begin.
        needed: number of detections that confirm a target,
        frames: of this number of last pictures,
        within_m: no further than this from one another and from the expected place, m.
        lost_s: time without a detection after which it is lost, s (on its own; in a mission after 3 s).
        spiral_s: duration of the search on a spiral after that, s (on its own; in a mission 10 s).
        spiral_speed: m/s, on it.
        spiral_pitch_m: from turn to turn of it, m.
        picture_s: period of recorded pictures with a target in them, s; others every 5 s.
        mosaic: mosaic of the ground from pictures, for the recording; default: none.
    """

    roster: Roster | None = None
    watch: Watch | None = None
    _alone = False  # whether it created the roster itself

    def __init__(
        self,
        *,
        watching: Watching | None = None,
        members: tuple[str, ...] = (),
        gain: Positive = GAIN,
        smoothing: Probability = SMOOTHING,
        max_speed: Positive = 4.0,
        height: Positive | None = None,
        needed: AT_LEAST_ONE = 3,
        frames: AT_LEAST_ONE = 5,
        within_m: Positive = WITHIN_M,
        lost_s: Positive = LOST_S,
        spiral_s: Positive = SPIRAL_S,
        spiral_speed: Positive = 2.0,
        spiral_pitch_m: Positive = 4.0,
        picture_s: Positive = 1.0,
        mosaic: Mosaicking | None = None,
    ) -> None:
        if needed > frames:
            raise ScenarioError(f"must be at most frames = {frames}, not {needed}", key="needed")
        self.members, self.height, self.max_speed = members, height, max_speed
        self._confirmation = partial(Confirmation, needed, frames, within_m)
        self._keeping = {"gain": gain, "smoothing": smoothing, "max_speed": max_speed, "within_m": within_m}
        self._searching = {"lost_s": lost_s, "spiral_s": spiral_s}
        self._spiral_speed, self._pitch_m = spiral_speed, spiral_pitch_m
        self._picture_s, self._mosaic = picture_s, mosaic
        self._own = None if watching is None else Watch(watching)
        self.sensors = () if self._own is None else self._own.sensors
        if mosaic is not None:
            _sheet(mosaic)

    def start(self, info: VehicleInfo) -> None:
        """Begin without a target; `ValueError`: the vehicle lacks equipment, or the gain is too large."""
        check_flies(info)
        if self.roster is None or self._alone:
            self._alone, self.roster = True, Roster(info.name, members_of(info, self.members))
        self.watch = self.watch or self._own
        if self.watch is None:
            raise ValueError("watching is missing: tracking needs the camera and the targets")
        if self.watch is self._own:
            self.watch.start(info)
        self._equipment = self.watch, self.roster
        self._camera = self.watch.settings.camera
        timing = {"latency_s": info.latency_s, "spiral_pitch_m": self._pitch_m, "spiral_speed": self._spiral_speed}
        searching = self._searching if self._alone else {"lost_s": LOST_S, "spiral_s": SPIRAL_S}  # as its table has it
        self._tracker = Tracker(info.period_s, **timing, **self._keeping, **searching)
        self._confirming = {name: self._confirmation() for name in sorted(self.watch.names)}
        self._showing = PictureRecording(self._camera, self._picture_s)
        self._sheet = None if self._mosaic is None else _sheet(self._mosaic)
        self._candidate: Claim | None = None  # confirmed by the newest picture, and unclaimed
        self._found_names: set[str] = set()
        self._note = ""  # the target in the last note
        self._asked_ns: int | None = None
        self._forget()
        self._home: Waypoint | None = None

    def _forget(self) -> None:
        self._target = ""
        self._since_ns: int | None = None  # it tracks since then; None: it does not
        self._there_ns = 0  # deadline to reach a target that was not seen yet
        self._whole_ns = 0  # time of the newest picture that was examined entirely
        self._height = 0.0

    @property
    def claim(self) -> Claim | None:
        """The tracked target, its present place, and the start of tracking."""
        if self._since_ns is None or self._asked_ns is None:
            return None
        return Claim(self._target, self._tracker.predicted(self._asked_ns), self._since_ns)

    @property
    def goal(self) -> Point | None:
        """Present place of the tracked target, x, y, m, world; None: no target."""
        return None if self.claim is None else self.claim.place

    def facts(self, obs: Observation) -> Mapping[str, Any]:
        """Facts from the newest picture: confirmed targets or, while tracking, the state of tracking."""
        watch, roster = self._equipment
        self._asked_ns = obs.clock_ns
        frame = watch.look(obs)
        self._candidate = None
        if frame is not None:
            self._take(obs, frame, roster)
        if self._sheet is not None and (mosaic := self._sheet.due_mosaic(obs.clock_ns)) is not None:
            self.show(mosaic)
        if self.claim is not None:
            self._aim(obs.clock_ns, watch)
            self._note_target()
            return {"seen_ns": self._tracker.seen_ns, "taken": roster.has_prior_claim(self.claim, obs.clock_ns)}
        return {} if self._candidate is None else {"recognised": True, "place": self._candidate.place}

    def begin(self, obs: Observation, place: Point | None) -> None:
        """Track the target at this place, m; None: below the vehicle."""
        place = obs.state.position[:2] if place is None else place
        candidate = self._candidate
        way_m = math.dist(place, obs.state.position[:2])
        self._since_ns = last_seen_ns = obs.clock_ns
        if candidate is not None and math.dist(candidate.place, place) <= self._tracker.within_m:
            self._target, last_seen_ns, self._there_ns = candidate.target, candidate.since_ns, 0
        else:
            self._target, self._there_ns = "", obs.clock_ns + seconds_to_ns(DETOUR * way_m / self.max_speed)
        self._tracker.begin(last_seen_ns, place)
        self._height = obs.state.position[2] if self.height is None else self.height
        self._note_target()

    def end(self, obs: Observation) -> None:
        """End tracking; its last place is given up if the target was lost or another vehicle tracks it."""
        watch, roster = self._equipment
        claim = self.claim
        lost = self._tracker.phase(obs.clock_ns) in ("spiral", "lost")
        if claim is not None and (lost or roster.has_prior_claim(claim, obs.clock_ns)):
            roster.give_up(claim.place, obs.clock_ns)
        self._tracker.end()
        self._forget()
        self._home, watch.region = None, None
        self._note_target()

    def act(self, obs: Observation, radio: Radio) -> Velocity | Waypoint:
        """Stay above the target; on its own, find one first."""
        if self._alone:
            self._decide(obs, radio)
        elif self._asked_ns != obs.clock_ns:
            self.facts(obs)
        if self._since_ns is None:
            x, y, z = obs.state.position
            self._home = self._home or Waypoint(position=(x, y, z if self.height is None else self.height))
            return self._home
        vx, vy = self._tracker.command(obs.clock_ns, obs.state.position)
        climb = max(-CLIMB, min(GAIN * (self._height - obs.state.position[2]), CLIMB))
        return Velocity(linear=(vx, vy, climb))

    def stand_by(self, obs: Observation, radio: Radio) -> None:
        """Continue to examine pictures."""
        if self._asked_ns != obs.clock_ns:
            self.facts(obs)

    def _decide(self, obs: Observation, radio: Radio) -> None:
        _, roster = self._equipment
        roster.hear(obs)
        facts = self.facts(obs)
        if self._since_ns is not None:
            if facts["taken"] or self._tracker.phase(obs.clock_ns) == "lost":
                self.end(obs)
        elif "place" in facts:
            self.begin(obs, facts["place"])
        roster.tell(obs, radio, "search" if self._since_ns is None else "track", self.claim)

    def _take(self, obs: Observation, frame: WatchFrame, roster: Roster) -> None:
        if (sightings := self._showing.of(frame)) is not None:
            self.show(sightings)
        if self._sheet is not None:
            self._sheet.lay(frame)
        if self._since_ns is not None:
            self._see(obs, frame)
        if frame.whole:
            self._whole_ns = frame.time_ns
        self._candidate = self._confirmed(obs, frame, roster)
        if self._candidate is not None and self._candidate.target not in self._found_names:
            (x, y), name = self._candidate.place, self._candidate.target
            self._found_names.add(name)
            self.note(found=name, found_x=x, found_y=y)

    def _see(self, obs: Observation, frame: WatchFrame) -> None:
        """Update tracking from a picture: whether the target is visible, and its name."""
        tracker = self._tracker
        if tracker.see(frame.time_ns, [each.place for each in frame.sightings if self._target in ("", each.target)]):
            place = tracker.predicted(frame.time_ns)
            self._target = self._target or next(each.target for each in frame.sightings if each.place == place)
            self._there_ns = 0
        elif obs.clock_ns < self._there_ns:
            place = tracker.predicted(frame.time_ns)
            if math.dist(place, obs.state.position[:2]) > tracker.within_m:
                tracker.begin(frame.time_ns, place)

    def _confirmed(self, obs: Observation, frame: WatchFrame, roster: Roster) -> Claim | None:
        """The nearest unclaimed target that the last pictures confirm; new ones first."""
        x, y, _ = obs.state.position
        claims: list[tuple[bool, float, Claim]] = []
        for name, confirmation in self._confirming.items():
            if not (frame.whole or name == self._target):
                continue  # it was not looked at
            place = confirmation.frame(each.place for each in frame.sightings if each.target == name)
            since_ns = self._since_ns if name == self._target and self._since_ns is not None else obs.clock_ns
            if place is not None and not roster.has_prior_claim(Claim(name, place, since_ns), obs.clock_ns):
                claims.append((name in self._found_names, math.dist(place, (x, y)), Claim(name, place, frame.time_ns)))
        return min(claims)[2] if claims else None

    def _aim(self, now_ns: int, watch: Watch) -> None:
        """Select the ground to examine in the next picture."""
        sees = self._tracker.phase(now_ns) in ("seen", "predicted") and self._target and now_ns - self._whole_ns < WHOLE_NS
        watch.region = GroundDisc(self._tracker.predicted(now_ns), self._tracker.reach_m(now_ns)) if sees else None

    def _note_target(self) -> None:
        if self._target != self._note:
            self._note = self._target
            self.note(target=self._target)


def _sheet(settings: Mosaicking) -> Sheet:
    """An empty mosaic; errors name the key."""
    try:
        return Sheet(settings)
    except ScenarioError as error:
        raise ScenarioError(error.problem, key=f"mosaic.{error.key}") from error
