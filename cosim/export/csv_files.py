"""Exports a recording as CSV files; headers contain the units.

``states.csv`` has the true states, ``errors.csv`` the formation error of each follower, ``radio.csv`` the columns of
``radio.parquet``, a row per frame and receiver, ``commands.csv`` the commands of agents, ``notes.csv`` their notes; for real
vehicles, ``real.csv`` has their status and the causes that limited them, ``incidents.csv`` their incidents. Each sensor with
numeric readings has a file of its name, with all vehicles in it. Times are simulated, s; an empty cell is a missing value.
Scans, pictures and maps are not exported: they do not fit into rows.
"""

import csv
import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv as arrow_csv

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.metrics.formation import errors_table
from vcmvsp.cosim.recording.foxglove import PoseInFrame
from vcmvsp.cosim.recording.mcap_reader import Recorded
from vcmvsp.cosim.recording.recorded_run import FILE, Source, Values, is_known, tables_of
from vcmvsp.cosim.tables.radio_frames import Frames
from vcmvsp.cosim.tables.schema import PART_ROWS, TableFile, radio_table
from vcmvsp.cosim.types import Imu, Incident, Odometry, RealStatus, VehicleState, Velocity, Waypoint
from vcmvsp.cosim.util import limits

TURN = ("qw", "qx", "qy", "qz")  # world_from_body
SPEEDS, RATES = ("vx_m_s", "vy_m_s", "vz_m_s"), ("wx_rad_s", "wy_rad_s", "wz_rad_s")
Tabular = VehicleState | Odometry | Imu | PoseInFrame | Velocity | Waypoint
COLUMNS: Mapping[type[Tabular], Sequence[str]] = {
    VehicleState: ("x_m", "y_m", "z_m", *TURN, "yaw_rad", *SPEEDS, *RATES),
    Odometry: ("x_m", "y_m", "yaw_rad", "v_m_s", "w_rad_s"),
    Imu: ("measured_s", "ax_m_s2", "ay_m_s2", "az_m_s2", *RATES),
    PoseInFrame: ("measured_s", "x_m", "y_m", "z_m", "yaw_rad", "sigma_m", "sigma_rad"),
    Velocity: (*SPEEDS, "yaw_rate_rad_s"),
    Waypoint: ("to_x_m", "to_y_m", "to_z_m", "to_yaw_rad", "speed_m_s"),
}
"""Columns for each type of value; values with names, such as notes, use their names as columns."""
FILES = {"state": "states", "command": "commands", "note": "notes", "estimate": "estimates", "incident": "incidents"}
"""File names by topic, where they differ from the topic's."""
RADIO, ERRORS, FRAMES = "radio", "errors", "radio/frame"
OPTIONS = arrow_csv.WriteOptions(quoting_style="needed")


def write_csv(source: Source, folder: Path) -> None:
    """Write the files into ``folder``, which exists and is empty.

    Raises:
        UsageError: a file would have more cells than `limits` allow.
    """
    try:
        headers, count, until = _headers(source)
    except ValueError as error:
        raise UsageError(f"--csv: {error}") from error
    with ExitStack() as stack:
        writers = {}
        for name, header in headers.items():
            stream = stack.enter_context((folder / f"{name}.csv").open("w", encoding="utf-8", newline=""))
            writers[name] = csv.writer(stream)
            writers[name].writerow(("time_s", "vehicle", *header))
        for record, value in islice(_read(source), count):  # a current run may have grown since the first pass
            if (row := _row(value)) is not None:
                vehicle, name = _place(record.topic)
                writers[name].writerow((record.time_ns / SECOND_NS, vehicle, *(row.get(each) for each in headers[name])))
    _write_radio(source, folder / f"{RADIO}.csv", *until)
    _write_errors(source, folder / f"{ERRORS}.csv", until[1])


def _read(source: Source) -> Iterator[tuple[Recorded, Any]]:
    values = Values()
    for record in source.only(lambda _, schema: is_known(schema)):
        yield record, None if record.topic == FRAMES else values.of(record)


def _headers(source: Source) -> tuple[dict[str, list[str]], int, tuple[int, int]]:
    """The columns of each file, from all values to be written; numbers of messages and frames, and the last time, ns."""
    headers: dict[str, dict[str, None]] = {}
    rows = Counter[str]()
    count = frames = end_ns = 0
    for record, value in _read(source):
        count, frames, end_ns = count + 1, frames + (record.topic == FRAMES), max(end_ns, record.time_ns)
        if (row := _row(value)) is not None:
            name = _place(record.topic)[1]
            rows[name] += 1
            headers.setdefault(name, {}).update(dict.fromkeys(row))
    most = max(limits.CELLS, (source.folder / FILE).stat().st_size)
    for name, columns in headers.items():
        limits.within(rows[name] * len(columns), most, f"cells of {name}.csv")
    return {name: list(columns) for name, columns in headers.items()}, count, (frames, end_ns)


def _place(topic: str) -> tuple[str, str]:
    vehicle, _, subtopic = topic.partition("/")
    if subtopic in FILES:
        return vehicle, FILES[subtopic]
    is_taken = subtopic in (RADIO, ERRORS) or subtopic in FILES.values()
    return vehicle, f"{subtopic.replace('/', '_')}{'_sensor' if is_taken else ''}"


def _row(value: object) -> Mapping[str, Any] | None:
    """The cells of a row by column; None for types without a row."""
    names = getattr(value, "values", None)
    if isinstance(names, dict):
        return names
    if isinstance(value, RealStatus | Incident):
        return _of_real_vehicle(value)
    if not isinstance(value, Tabular):
        return None
    return {name: _cell_text(cell) for name, cell in zip(COLUMNS[type(value)], _cells(value), strict=True)}


def _of_real_vehicle(value: RealStatus | Incident) -> Mapping[str, object]:
    if isinstance(value, Incident):
        return {"what": value.what, "cause": value.cause, "happened_s": value.happened_ns / SECOND_NS}
    cells = {name: _cell_text(cell) for name, cell in msgspec.structs.asdict(value).items() if name != "sent"}
    sent = [None] * 4 if value.sent is None else _cells(value.sent)
    row = {f"sent_{name}": cell for name, cell in zip(COLUMNS[Velocity], sent, strict=True)}
    return {**cells, "causes": "; ".join(value.causes), **row}


def _cell_text(cell: object) -> object:
    return None if isinstance(cell, float) and math.isnan(cell) else cell


def _cells(value: Tabular) -> Sequence[object]:
    match value:
        case VehicleState(position=p, velocity=v, attitude=q, angular_velocity=w):
            return (*p, *q, value.yaw, *v, *w)
        case Odometry(pose=pose, v=v, w=w):
            return (*pose, v, w)
        case Imu(acceleration=a, angular_velocity=w, time_ns=at_ns):
            return (at_ns / SECOND_NS, *a, *w)
        case Velocity(linear=v, yaw_rate=w):
            return (*v, w)
        case Waypoint(position=p, yaw=yaw, speed=speed):
            return (*p, yaw, speed)
        case PoseInFrame(pose=pose, timestamp=measured, yaw=yaw, sigma_m=sigma_m):
            sigma_rad = None if yaw is None else value.sigma_rad
            return (measured.ns / SECOND_NS, pose.position.x, pose.position.y, pose.position.z, yaw, sigma_m, sigma_rad)


def _write_radio(source: Source, path: Path, count: int, end_ns: int) -> None:
    """Write the run's radio table or, if it is missing, the frames in the recording."""
    own = source.folder / f"{RADIO}.parquet"
    try:
        _write_parts(TableFile(own).blocks(), path)
    except FileNotFoundError:
        _write_recorded(source, path, count, end_ns, f"no {own.name} here")
    except (OSError, ValueError):  # the run was killed during the write
        _write_recorded(source, path, count, end_ns, f"{own.name} cannot be read")


def _write_errors(source: Source, path: Path, end_ns: int) -> None:
    try:
        recording = tables_of(source.folder, radio=(), before_ns=end_ns)
    except UsageError:  # a recording of one instant so far
        return
    except (OSError, ValueError) as error:
        source.tell(f"{source.folder}: no {path.name}: {error}")
        return
    if recording.follows:
        _write_parts(iter((errors_table(recording.states, recording.facts),)), path)


def _write_recorded(source: Source, path: Path, count: int, end_ns: int, why: str) -> None:
    source.tell(f"{source.folder}: {why}: {RADIO}.csv lacks frames of programs, and routes")
    frames, values = Frames(source.vehicles), Values()
    records = (each for each in source.only(lambda topic, _: topic == FRAMES) if each.topic)
    frames.extend(map(values.of, islice(records, count)))
    table = radio_table(frames, source.facts(end_ns))
    _write_parts((table.slice(row, PART_ROWS) for row in range(0, max(1, table.num_rows), PART_ROWS)), path)


def _write_parts(parts: Iterator[pa.Table], path: Path) -> None:
    with ExitStack() as stack:
        writer: arrow_csv.CSVWriter | None = None
        for part in map(_for_csv, parts):
            writer = writer or stack.enter_context(arrow_csv.CSVWriter(path, part.schema, write_options=OPTIONS))
            writer.write_table(part)


def _for_csv(table: pa.Table) -> pa.Table:
    columns: dict[str, Any] = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        if name.endswith("_ns"):
            columns[f"{name.removesuffix('_ns')}_s"] = pc.divide(column.cast(pa.float64()), float(SECOND_NS))
        elif pa.types.is_floating(column.type):
            columns[name] = pc.if_else(pc.is_nan(column), None, column)
        else:
            columns[name] = column.cast(pa.string()) if pa.types.is_dictionary(column.type) else column
    return pa.table(columns)
