"""A recorded run, read back from its folder: how things stood at any time of it."""

from array import array
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError, VcmvspError
from vcmvsp.cosim.recording.foxglove.agent_displays import PICTURE
from vcmvsp.cosim.recording.run_mcap import CALIBRATION, MOVING, SCENE
from vcmvsp.cosim.types import Fix, Image, Scan, Sightings, States
from vcmvsp.cosim.view.messages import LogLine, PageUpdate, Scenery
from vcmvsp.cosim.view.player import decoding as values
from vcmvsp.cosim.view.player.frame_counts import Counts
from vcmvsp.cosim.view.player.mcap_index import Messages, Taker, Topic
from vcmvsp.cosim.view.player.recorded_scenery import Stage, bare_stage, stage_of

T = TypeVar("T")
FILE = "run.mcap"
LINES = 200  # of the log, at once
FRAMES, LOG, HALTED = "radio/frame", "log", "operator/halted"
SCAN, IMAGE, FIX = "foxglove.LaserScan", "foxglove.RawImage", "foxglove.PoseInFrame"  # schemas
STATE, HEARD, NOTE, SIGHTINGS = "state", "heard", "note", "sightings"  # of each vehicle
NEWEST: Mapping[str, tuple[str, Callable[[bytes], Any]]] = {
    "follows": ("places", values.follows_of),
    "host": ("presence", values.presence_of),
    "real": ("real", values.real_of),
    "map": ("maps", values.map_of),
    "mosaic": ("mosaics", values.mosaic_of),
}
"""Of each vehicle: a topic, the field of `PageUpdate` in which its newest message stands, and how it is read."""


class Recording:
    """A run's folder, for one thread.

    That of a run which goes on, or was killed, shows what there is. Only the index is in memory, and what is looked at is read:
    to jump to another time costs about as much as to go on.

    Args:
        run_dir: the folder.
        trust: import classes that its scenario names and that are not built in, for exact shapes.

    Attributes:
        vehicles: of the run, in its order.
        end_ns: how far the recording goes.
        ending: why it goes no further.
        troubles: what cannot be shown, and why.

    Raises:
        UsageError: there is no such folder, or nothing of a recording in it.
    """

    def __init__(self, run_dir: str | Path, trust: bool = False) -> None:
        self._folder, self._trust = Path(run_dir), trust
        self._file = _opened(self._folder)
        self._collected = Accumulator(self._file.about)
        try:
            self._read()
        except BaseException:
            self.close()
            raise

    def _read(self) -> None:
        file, collected = self._file, self._collected
        damage = file.read(_is_wanted, collected.taker)
        self.vehicles, self.end_ns = collected.vehicles, file.end_ns
        if not self.vehicles or not file.topics:
            raise UsageError(f"{self._folder / FILE}: nothing in it can be read: {damage or 'it holds no run'}")
        collected.close()
        self.troubles = [f"{FILE} can be read up to {self.end_ns / SECOND_NS:.3f} s: {damage}"] if damage else []
        self.ending = damage or (collected.lines[-1].text if collected.lines else "the recording ends here")
        self._stage = self._staged()
        collected.lines[:0] = [LogLine(time_ns=0, level="warning", text=text) for text in self.troubles]

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    @property
    def scenery(self) -> Scenery:
        """What does not change; of sensors, those whose readings were recorded."""
        known = self._stage.scenery
        crafts = [msgspec.structs.replace(each, sensors=self._sensors(each.name, each.sensors)) for each in known.vehicles]
        return msgspec.structs.replace(known, vehicles=tuple(crafts), duration_ns=self.end_ns)

    def at(self, time_ns: int, since_ns: int | None = None, sensors: Sequence[str] = ()) -> PageUpdate:
        """How things stood at a time: the newest of everything that was recorded by then.

        Args:
            time_ns: that time.
            since_ns: an earlier time: what has not been recorded anew since then is left out. None: nothing is.
            sensors: whose readings are wanted, by vehicle/sensor.

        Raises:
            UsageError: the file is not what it was, or another version wrote it.
        """
        scans, images = self.readings(time_ns, since_ns, sensors)
        counts = self._collected.counts
        first, last = 0 if since_ns is None else counts.frames(since_ns), counts.frames(time_ns)
        sent, received = counts.at(time_ns) if since_ns is None or first < last else (None, None)
        return PageUpdate(
            time_ns=time_ns,
            states=self._states(time_ns, since_ns),
            obstacles=_changed(self._obstacles, time_ns, since_ns),
            targets=_changed(self._targets, time_ns, since_ns),
            scans=scans,
            images=images,
            sightings=self._each(SIGHTINGS, self._sightings, time_ns, since_ns),
            links=tuple(self._message(self._file.topics[FRAMES], k, values.link_of) for k in counts.newest(first, last)),
            sent=sent,
            received=received,
            heard_ns=self._each(HEARD, Topic.time_ns, time_ns, since_ns),
            halted=self._collected.halted(time_ns),
            lines=self._collected.said(time_ns, since_ns),
            notes=self._each(NOTE, self._noted, time_ns, since_ns),
            fixes=self._fixes(time_ns, since_ns),
            **self._newest(time_ns, since_ns),
        )

    def readings(self, time_ns: int, since_ns: int | None, sensors: Sequence[str]) -> tuple[dict[str, Scan], dict[str, Image]]:
        """The newest sweeps and pictures of these sensors (vehicle/sensor); ``since_ns`` and errors as in `at`."""
        scans: dict[str, Scan] = {}
        images: dict[str, Image] = {}
        for name in sensors:
            topic = self._file.topics.get(name)
            number = -1 if topic is None else _newest(topic, time_ns, since_ns)
            if topic is None or number < 0:
                continue
            if topic.schema == SCAN:
                scans[name] = self._message(topic, number, values.scan_of)
            elif topic.schema == IMAGE:
                images[name] = self._image(topic, number)
        return scans, images

    def _staged(self) -> Stage:
        """Where the run took place; without its scenario, or its world, the vehicles are shown alone."""
        path, why = self._folder / "scenario.toml", "there is no scenario.toml (yet)"
        topic = self._file.topics.get(SCENE)
        drawing = None if topic is None else self._message(topic, 0, bytes)
        if path.is_file():
            try:
                return stage_of(path, self.vehicles, drawing, trust=self._trust)
            except (VcmvspError, ValueError) as error:
                why = str(error)
        self.troubles.append(f"the world is not shown: {why}")
        try:
            return bare_stage(self._file.about, self.vehicles, drawing)
        except ValueError as error:
            raise UsageError(f"{self._folder / FILE}: the message that draws the vehicles cannot be read: {error}") from error

    def _sensors(self, vehicle: str, kinds: Mapping[str, str]) -> dict[str, str]:
        """Names and kinds of a vehicle's sensors that there are readings of."""
        read = [name.partition("/") for name, topic in self._file.topics.items() if _is_reading(topic.schema)]
        return {sensor: kinds.get(sensor, "") for who, _, sensor in read if who == vehicle}

    def _message(self, topic: Topic, number: int, decode: Callable[[bytes], T]) -> T:
        try:
            return decode(self._file.get(topic, number))
        except (OSError, ValueError) as error:
            said = f"{self._folder / FILE}: a message of {topic.name} cannot be read any more, or is of another version"
            raise UsageError(f"{said}: {error}") from error

    def _each(self, what: str, read: Callable[[Topic, int], T], time_ns: int, since_ns: int | None) -> dict[str, T]:
        """Each vehicle's newest message of such a topic, if there is one, read by topic and number."""
        found: dict[str, T] = {}
        for vehicle in self.vehicles:
            topic = self._file.topics.get(f"{vehicle}/{what}")
            if topic is not None and (number := _newest(topic, time_ns, since_ns)) >= 0:
                found[vehicle] = read(topic, number)
        return found

    def _newest(self, time_ns: int, since_ns: int | None) -> dict[str, Any]:
        """The fields of `NEWEST`."""
        return {
            field: self._each(what, partial(self._message, decode=decode), time_ns, since_ns)
            for what, (field, decode) in NEWEST.items()
        }

    def _states(self, time_ns: int, since_ns: int | None) -> States | None:
        """The newest that are whole: where a file was cut, the last ones may be of some vehicles only."""
        found = [topic for name in self.vehicles if (topic := self._file.topics.get(f"{name}/{STATE}")) is not None]
        numbers = [topic.newest(time_ns) for topic in found]
        if len(found) < len(self.vehicles) or min(numbers) < 0:
            return None
        when_ns = min(topic.time_ns(number) for topic, number in zip(found, numbers, strict=True))
        if since_ns is not None and when_ns <= since_ns:
            return None
        rows = [self._message(topic, topic.newest(when_ns), values.state_of) for topic in found]
        return values.states_of(self.vehicles, rows)

    def _noted(self, topic: Topic, number: int) -> dict[str, Any]:
        return self._collected.notes[topic.name].at(number, lambda each: self._message(topic, each, bytes))

    def _fixes(self, time_ns: int, since_ns: int | None) -> dict[str, Fix]:
        """The newest of each vehicle, whichever of its sensors it came from."""
        newest: dict[str, tuple[int, Topic, int]] = {}
        for topic in self._file.topics.values():
            if topic.schema == FIX and (number := _newest(topic, time_ns, since_ns)) >= 0:
                vehicle, when_ns = topic.name.partition("/")[0], topic.time_ns(number)
                if vehicle not in newest or newest[vehicle][0] <= when_ns:
                    newest[vehicle] = when_ns, topic, number
        return {name: self._message(topic, number, values.fix_of) for name, (_, topic, number) in newest.items()}

    def _sightings(self, topic: Topic, number: int) -> Sightings:
        """With the picture of the same time, where there is one."""
        pictures, when_ns, jpeg = self._file.topics.get(f"{topic.name}/{PICTURE}"), topic.time_ns(number), None
        if pictures is not None and (of_then := pictures.newest(when_ns)) >= 0 and pictures.time_ns(of_then) == when_ns:
            jpeg = self._message(pictures, of_then, bytes)
        return self._message(topic, number, lambda data: values.sightings_of(data, jpeg))

    def _image(self, topic: Topic, number: int) -> Image:
        told = self._file.topics.get(f"{topic.name}/{CALIBRATION}")
        lens = None if told is None else self._message(told, 0, bytes)
        return self._message(topic, number, lambda data: values.image_of(data, lens))

    def _obstacles(self, time_ns: int) -> dict[str, tuple[float, float, float, float]]:
        """Where those are that keep to a time-table, and those that can be pushed."""
        moving = () if self._stage.world is None else self._stage.world.moving
        places: dict[str, tuple[float, float, float, float]] = {}
        if (topic := self._file.topics.get(MOVING)) is not None and (number := topic.newest(time_ns)) >= 0:
            places = self._message(topic, number, values.frames_of)
        return places | {each.name: each.pose(time_ns / SECOND_NS) for each in moving}

    def _targets(self, time_ns: int) -> dict[str, tuple[float, float]]:
        targets = () if self._stage.world is None else self._stage.world.targets
        return {each.name: each.place(time_ns / SECOND_NS) for each in targets}


class Accumulator:
    """What only all messages of a topic tell: counts of frames, lines of the log, notes, stopped vehicles.

    Args:
        about: what the recording says of its run, known before its first message.
    """

    def __init__(self, about: Mapping[str, str]) -> None:
        self._about = about
        self.counts = Counts(())
        self.lines: list[LogLine] = []
        self.notes: dict[str, Notes] = {}  # by topic
        self._halted: list[tuple[int, tuple[str, ...]]] = []

    @property
    def vehicles(self) -> tuple[str, ...]:
        """Those of the run, in its order."""
        return tuple(self._about.get("vehicles", "").split())

    def taker(self, topic: str) -> Taker | None:
        """What takes all messages of a topic, if they are needed."""
        if topic.partition("/")[2] == NOTE:
            self.notes[topic] = Notes()
            return self.notes[topic].take
        takers = {FRAMES: self._take_frame, LOG: self._take_line, HALTED: self._take_halted}
        return takers.get(topic)

    def close(self) -> None:
        """There are no more."""
        if not self.counts.vehicles:  # there was no frame
            self.counts = Counts(self.vehicles)
        self.counts.close()

    def halted(self, time_ns: int) -> tuple[str, ...]:
        """Whom the operator has stopped."""
        return next((names for when_ns, names in reversed(self._halted) if when_ns <= time_ns), ())

    def said(self, time_ns: int, since_ns: int | None) -> tuple[LogLine, ...]:
        """The newest lines of the log; ``since_ns``: those that were later."""
        from_ns = -1 if since_ns is None else since_ns
        return tuple(line for line in self.lines if from_ns < line.time_ns <= time_ns)[-LINES:]

    def _take_frame(self, time_ns: int, data: bytes) -> None:
        if not self.counts.vehicles:
            self.counts = Counts(self.vehicles)
        self.counts.take(time_ns, data)

    def _take_line(self, time_ns: int, data: bytes) -> None:
        self.lines.append(values.line_of(data, time_ns))

    def _take_halted(self, time_ns: int, data: bytes) -> None:
        said = values.halted_of(data)
        stand = {name for name in (self._halted[-1][1] if self._halted else ()) if name not in said.vehicles}
        stand |= {*said.vehicles} if said.halted else set()
        self._halted.append((time_ns, tuple(name for name in self.vehicles if name in stand)))


class Notes:
    """The notes of one vehicle. They are told apart by what they name, and of each sort only the newest is read."""

    def __init__(self) -> None:
        self._sorts: dict[tuple[str, ...], array[int]] = {}  # names -> numbers of the notes that have them
        self._count = 0

    def take(self, _: int, data: bytes) -> None:
        """The next note."""
        self._sorts.setdefault(tuple(values.note_of(data)), array("q")).append(self._count)
        self._count += 1

    def at(self, number: int, get: Callable[[int], bytes]) -> dict[str, Any]:
        """All that was noted up to the note of this number; ``get`` gives a note by its number."""
        newest = [numbers[place - 1] for numbers in self._sorts.values() if (place := bisect_right(numbers, number))]
        noted: dict[str, Any] = {}
        for each in sorted(newest):
            noted |= values.note_of(get(each))
        return noted


def _opened(folder: Path) -> Messages:
    path = folder / FILE
    if not path.is_file():
        problem = f"has no {FILE}" if folder.is_dir() else "there is no such folder"
        raise UsageError(f"{folder}: {problem}; name the folder that a run left (runs/NAME-SEED, or its --out)")
    try:
        return Messages(path)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def _is_reading(schema: str) -> bool:
    return schema in (SCAN, IMAGE)


def _is_wanted(topic: str, schema: str) -> bool:
    """Whether messages of a topic are shown."""
    what = topic.partition("/")[2]
    of_vehicle = what in NEWEST or what in (STATE, HEARD, NOTE, SIGHTINGS, f"{SIGHTINGS}/{PICTURE}")
    of_run = topic in (FRAMES, LOG, HALTED, MOVING, SCENE)
    return of_vehicle or of_run or _is_reading(schema) or schema == FIX or topic.endswith(f"/{CALIBRATION}")


def _newest(topic: Topic, time_ns: int, since_ns: int | None) -> int:
    """The number of the newest message at a time; -1: there is none, or it is none that was recorded after another time."""
    number = topic.newest(time_ns)
    return -1 if number >= 0 and since_ns is not None and topic.time_ns(number) <= since_ns else number


def _changed(of: Callable[[int], dict[str, T]], time_ns: int, since_ns: int | None) -> dict[str, T]:
    """Of a mapping that depends on the time, what has changed since another time."""
    before = {} if since_ns is None else of(since_ns)
    return {name: value for name, value in of(time_ns).items() if name not in before or before[name] != value}
