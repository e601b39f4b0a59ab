"""Playback of a recorded run: its state at any time, and a player that shows it at a chosen pace."""

import queue
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.recording.foxglove import PICTURE, ImageAnnotations
from vcmvsp.cosim.recording.mcap_reader import Recorded
from vcmvsp.cosim.recording.recorded_run import FILE, Values, states_of, vehicles_of
from vcmvsp.cosim.recording.run_mcap import CALIBRATION, MOVING, SCENE
from vcmvsp.cosim.recording.run_state import LogLine
from vcmvsp.cosim.types import Fix, Sightings, States
from vcmvsp.cosim.view.messages import Go, Order, Pace, PageUpdate, Pose, Scenery, Seek, Sensors
from vcmvsp.cosim.view.player import decoding
from vcmvsp.cosim.view.player.collected import FRAMES, HALTED, LOG, NOTE, Collected
from vcmvsp.cosim.view.player.mcap_index import Messages, Topic
from vcmvsp.cosim.view.scenery import bare_scenery, recorded_stage

if TYPE_CHECKING:
    from vcmvsp.cosim.assembly import worlds

T = TypeVar("T")
SCAN, IMAGE, FIX = "foxglove.LaserScan", "foxglove.RawImage", "foxglove.PoseInFrame"  # schemas
STATE, SIGHTINGS = "state", "sightings"  # topics of each vehicle
NEWEST = {"follows": "places", "host": "presence", "real": "real", "map": "maps", "mosaic": "mosaics"}
"""Topics of vehicles, with the field of `PageUpdate` that holds the newest message unchanged."""
FASTEST, SLOWEST = 100.0, 0.01  # simulated seconds per second


class Recording:
    """The recording in a run's folder, for one thread.

    The recording of a current or killed run shows its available part. Memory holds only the index; messages are read on demand,
    so a jump costs about as much as continued playback.

    Args:
        run_dir: the folder.
        trust: import classes of the scenario that are not built in, for exact shapes.

    Attributes:
        vehicles: vehicles of the run, in its order.
        end_ns: end of the recording.
        ending: reason for the end of the recording.
        troubles: parts that cannot be shown, with reasons.

    Raises:
        UsageError: the folder does not exist or contains no readable recording.
    """

    def __init__(self, run_dir: str | Path, trust: bool = False) -> None:
        self._folder, self._trust = Path(run_dir), trust
        self._file = _opened(self._folder)
        self._values = Values(decoding.ALSO)
        self._world: worlds.World | None = None  # if it can be built
        try:
            self._collected = Collected(vehicles_of(self._file.about, self._folder / FILE))
            self._read()
        except BaseException:
            self.close()
            raise

    def _read(self) -> None:
        file, collected = self._file, self._collected
        damage = file.read(_is_wanted, collected.taker)
        self.vehicles, self.end_ns = collected.vehicles, file.end_ns
        if not self.vehicles or not file.topics:
            raise UsageError(f"{self._folder / FILE}: cannot be read: {damage or 'it contains no run'}")
        collected.close()
        self.troubles = [f"{FILE} can be read up to {self.end_ns / SECOND_NS:.3f} s: {damage}"] if damage else []
        self.ending = damage or collected.ending or "the recording ends here"
        scenery = self._staged()
        collected.lines[:0] = [LogLine(time_ns=0, level="warning", text=text) for text in self.troubles]
        crafts = [msgspec.structs.replace(each, sensors=self._sensors(each.name, each.sensors)) for each in scenery.vehicles]
        events_ns = tuple(dict.fromkeys(line.time_ns for line in collected.lines))
        self.scenery = msgspec.structs.replace(scenery, vehicles=tuple(crafts), duration_ns=self.end_ns, events_ns=events_ns)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def at(self, time_ns: int, since_ns: int | None = None, sensors: Sequence[str] = ()) -> PageUpdate:
        """State at a time: the newest recorded values up to it.

        Args:
            time_ns: time of the state.
            since_ns: an earlier time: values not recorded since then are omitted. None: all are included.
            sensors: sensors with wanted readings, as vehicle/sensor.

        Raises:
            UsageError: the file has changed, or another version wrote it.
        """
        counts, span = self._collected.counts, (time_ns, since_ns)
        first, last = 0 if since_ns is None else counts.frames(since_ns), counts.frames(time_ns)
        newest: dict[str, Any] = {field: self._each(subtopic, self._value, *span) for subtopic, field in NEWEST.items()}
        newest |= self.readings(*span, sensors)
        sent, received = counts.at(time_ns) if since_ns is None or first < last else (None, None)
        return PageUpdate(
            time_ns=time_ns,
            states=self._states(*span),
            obstacles=_changed(self._obstacles, *span),
            targets=_changed(self._targets, *span),
            sightings=self._each(SIGHTINGS, self._sightings, *span),
            links=tuple(self._value(self._file.topics[FRAMES], k) for k in counts.newest(first, last)),
            sent=sent,
            received=received,
            heard_ns=counts.last_reception_ns(*span),
            halted=self._collected.halted(time_ns),
            lines=self._collected.log_lines(*span),
            notes=self._each(NOTE, self._noted, *span),
            fixes=self._fixes(*span),
            **newest,
        )

    def readings(self, time_ns: int, since_ns: int | None, sensors: Sequence[str]) -> dict[str, Any]:
        """The newest ``scans`` and ``images`` of these sensors (vehicle/sensor); ``since_ns`` and errors as in `at`."""
        readings: dict[str, Any] = {"scans": {}, "images": {}}
        for name in sensors:
            topic = self._file.topics.get(name)
            if topic is None or not _is_reading(topic.schema) or (number := topic.newest(time_ns, since_ns)) < 0:
                continue
            reading = self._value(topic, number)
            if topic.schema == IMAGE:
                readings["images"][name] = decoding.image_of(reading, self._first(f"{name}/{CALIBRATION}"))
            else:
                readings["scans"][name] = reading
        return readings

    def _staged(self) -> Scenery:
        """The scenery of the run; without its scenario or its world, only the vehicles."""
        path, why = self._folder / "scenario.toml", "scenario.toml is missing"
        topic = self._file.topics.get(SCENE)
        drawing = None if topic is None else self._content(topic, 0)
        if path.is_file():
            try:
                scenery, self._world = recorded_stage(path, self.vehicles, drawing, trust=self._trust)
            except (VcmvspError, ValueError) as error:
                why = str(error)
            else:
                return scenery
        self.troubles.append(f"the world is not shown: {why}")
        try:
            return bare_scenery(self._file.about, self.vehicles, drawing)
        except ValueError as error:
            raise UsageError(f"{self._folder / FILE}: the message that draws the vehicles cannot be read: {error}") from error

    def _sensors(self, vehicle: str, kinds: Mapping[str, str]) -> dict[str, str]:
        read = [name.partition("/") for name, topic in self._file.topics.items() if _is_reading(topic.schema)]
        return {sensor: kinds.get(sensor, "") for owner, _, sensor in read if owner == vehicle}

    def _content(self, topic: Topic, number: int) -> bytes:
        try:
            return self._file.get(topic, number)
        except (OSError, ValueError) as error:
            problem = f"{self._folder / FILE}: a message of {topic.name} is damaged or of another version"
            raise UsageError(f"{problem}: {error}") from error

    def _value(self, topic: Topic, number: int) -> Any:
        message = Recorded(topic.name, topic.schema, topic.time_ns(number), self._content(topic, number))
        value = self._values.of(message)
        convert = decoding.SHOWN_AS.get(type(value))
        return value if convert is None else convert(value)

    def _first(self, name: str) -> Any:
        topic = self._file.topics.get(name)
        return None if topic is None else self._value(topic, 0)

    def _each(self, subtopic: str, read: Callable[[Topic, int], T], time_ns: int, since_ns: int | None) -> dict[str, T]:
        """Each vehicle's newest message of a topic, if any, read by topic and number."""
        topics = {vehicle: self._file.topics.get(f"{vehicle}/{subtopic}") for vehicle in self.vehicles}
        newest = [(vehicle, topic, topic.newest(time_ns, since_ns)) for vehicle, topic in topics.items() if topic is not None]
        return {vehicle: read(topic, number) for vehicle, topic, number in newest if number >= 0}

    def _states(self, time_ns: int, since_ns: int | None) -> States | None:
        """The newest complete states: at the end of a cut file, states may cover some vehicles only."""
        topics = [topic for name in self.vehicles if (topic := self._file.topics.get(f"{name}/{STATE}")) is not None]
        numbers = [topic.newest(time_ns) for topic in topics]
        if len(topics) < len(self.vehicles) or min(numbers) < 0:
            return None
        when_ns = min(topic.time_ns(number) for topic, number in zip(topics, numbers, strict=True))
        if since_ns is not None and when_ns <= since_ns:
            return None
        rows = [self._value(topic, topic.newest(when_ns)) for topic in topics]
        return states_of(dict(zip(self.vehicles, rows, strict=True)))

    def _noted(self, topic: Topic, number: int) -> dict[str, Any]:
        return self._collected.notes[topic.name].at(number, lambda each: self._value(topic, each))

    def _fixes(self, time_ns: int, since_ns: int | None) -> dict[str, Fix]:
        """The newest fix of each vehicle, from any of its sensors."""
        topics = [topic for topic in self._file.topics.values() if topic.schema == FIX]
        newest = [(topic.time_ns(k), topic, k) for topic in topics if (k := topic.newest(time_ns, since_ns)) >= 0]
        by_vehicle = {topic.name.partition("/")[0]: (topic, k) for _, topic, k in sorted(newest, key=lambda each: each[0])}
        return {name: self._value(topic, number) for name, (topic, number) in by_vehicle.items()}

    def _sightings(self, topic: Topic, number: int) -> Sightings:
        """Sightings with the picture of the same time, if any."""
        pictures, when_ns, picture = self._file.topics.get(f"{topic.name}/{PICTURE}"), topic.time_ns(number), None
        if pictures is not None and (of_then := pictures.newest(when_ns)) >= 0 and pictures.time_ns(of_then) == when_ns:
            picture = self._value(pictures, of_then)
        message: ImageAnnotations = self._value(topic, number)
        return message.sightings(b"" if picture is None else picture.data)

    def _obstacles(self, time_ns: int) -> dict[str, Pose]:
        moving = () if self._world is None else self._world.moving
        topic = self._file.topics.get(MOVING)
        number = -1 if topic is None else topic.newest(time_ns)
        recorded = {} if topic is None or number < 0 else self._value(topic, number)
        return recorded | {each.name: each.pose(time_ns / SECOND_NS) for each in moving}

    def _targets(self, time_ns: int) -> dict[str, tuple[float, float]]:
        targets = () if self._world is None else self._world.targets
        return {each.name: each.place(time_ns / SECOND_NS) for each in targets}


def _opened(folder: Path) -> Messages:
    path = folder / FILE
    if not path.is_file():
        problem = f"has no {FILE}" if folder.is_dir() else "there is no such folder"
        raise UsageError(f"{folder}: {problem}; name the folder of a run (runs/NAME-SEED, or its --out)")
    try:
        return Messages(path)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def _is_reading(schema: str) -> bool:
    return schema in (SCAN, IMAGE)


def _is_wanted(topic: str, schema: str) -> bool:
    subtopic = topic.partition("/")[2]
    of_vehicle = subtopic in NEWEST or subtopic in (STATE, NOTE, SIGHTINGS, f"{SIGHTINGS}/{PICTURE}")
    of_run = topic in (FRAMES, LOG, HALTED, MOVING, SCENE)
    return of_vehicle or of_run or _is_reading(schema) or schema == FIX or topic.endswith(f"/{CALIBRATION}")


def _changed(of: Callable[[int], dict[str, T]], time_ns: int, since_ns: int | None) -> dict[str, T]:
    """Entries of a time-dependent mapping that have changed since another time."""
    before = {} if since_ns is None else of(since_ns)
    return {name: value for name, value in of(time_ns).items() if name not in before or before[name] != value}


class Player:
    """Plays a recording from its start after the first order; pauses at the end."""

    def __init__(self, recording: Recording, clock: Callable[[], float] = time.monotonic) -> None:
        self._recording, self._clock = recording, clock
        self._orders: queue.SimpleQueue[Order] = queue.SimpleQueue()
        self._paused, self._speed = True, 1.0
        self._from_s, self._from_ns = clock(), 0  # wall-clock time of the last order, and position at that time
        self._until_ns = recording.end_ns  # position of the next pause
        self._sensors: tuple[str, ...] = ()
        self._last_ns: int | None = None  # position shown last

    def order(self, order: Order) -> None:
        """Queue an order for the next `show`; orders that a recording cannot execute are ignored. For any thread."""
        self._orders.put(order)

    def show(self) -> PageUpdate:
        """State at the present position, without values unchanged since the last call. For one thread.

        Raises:
            UsageError: see `Recording.at`.
        """
        before = self._sensors
        while not self._orders.empty():
            self._obey(self._orders.get())
        now_ns = self._now_ns()
        if now_ns >= self._until_ns:
            self._paused, self._from_ns = True, now_ns
        since_ns = None if self._last_ns is None or now_ns < self._last_ns else self._last_ns
        self._last_ns = now_ns
        update = self._recording.at(now_ns, since_ns, self._sensors)
        if names := [name for name in self._sensors if name not in before]:  # the newest, of any age
            readings = self._recording.readings(now_ns, None, names)
            update = msgspec.structs.replace(update, **{name: getattr(update, name) | new for name, new in readings.items()})
        return msgspec.structs.replace(update, pace=self._pace(now_ns))

    def _obey(self, order: Order) -> None:
        now_ns, end_ns = self._now_ns(), self._recording.end_ns
        match order:
            case Sensors():
                self._sensors = order.names
            case Seek():
                self._go_from(min(max(order.time_ns, 0), end_ns))
            case Go() if order.speed is None or order.speed > 0.0:
                self._paused = order.paused and order.step_ns <= 0
                self._speed = FASTEST if order.speed is None else min(max(order.speed, SLOWEST), FASTEST)
                self._go_from(0 if now_ns == end_ns and not order.paused else now_ns)
                if order.paused and order.step_ns > 0:
                    self._until_ns = min(now_ns + order.step_ns, end_ns)

    def _now_ns(self) -> int:
        if self._paused:
            return self._from_ns
        gone_ns = int((self._clock() - self._from_s) * self._speed * SECOND_NS)
        return min(self._from_ns + gone_ns, self._until_ns)

    def _go_from(self, time_ns: int) -> None:
        self._from_s, self._from_ns, self._until_ns = self._clock(), time_ns, self._recording.end_ns

    def _pace(self, now_ns: int) -> Pace:
        over = self._recording.ending if now_ns >= self._recording.end_ns else ""
        return Pace(paused=self._paused, speed=self._speed, achieved=None if self._paused else self._speed, over=over)
