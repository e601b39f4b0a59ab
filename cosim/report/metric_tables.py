"""The numbers of a run as tables: each with its unit, and what it is in a line for readers of a page."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from vcmvsp.cosim.report.page import Part, Rows, Words

UNITS = {
    "m_s2": "m/s²",
    "rad_s2": "rad/s²",
    "m2_s": "m²/s",
    "m_s": "m/s",
    "rad_s": "rad/s",
    "1_s": "1/s",
    "s": "s",
    "m": "m",
    "bytes_sent": "bytes",
}
"""By the end of a name."""
GROUPS = {
    "formation": (
        "Formation",
        "The error z of a follower is how far its handle, a point ahead of its centre, is from where it belongs in the frame "
        "of its leader. True poses count, whatever vehicles believed.",
    ),
    "radio": ("Radio", "A frame counts once for each vehicle that it was meant for. Ages are of the newest message received."),
    "routing": ("Routing", "A message counts once for each vehicle that it was meant for, whoever passed it on."),
    "control": ("Commands", "Velocities as commanded, each held until the next."),
    "connectivity": ("Connectivity", "The graph of those who heard each other, either way, within a second."),
    "safety": ("Safety", ""),
    "mission": ("Mission", "A find counts where a target truly was within 3 m."),
    "hardware": ("Real vehicles", ""),
}
"""Title and introduction of each group of numbers; faults of agents are told of elsewhere."""
WORDS = {  # ``*`` stands for a name; `cosim.metrics` says how each is computed
    "formation.rms_m": "root mean square of |z| over followers and window",
    "formation.mean_m": "mean of |z| over followers and window",
    "formation.max_m": "greatest |z| in the window",
    "formation.final_m": "greatest |z| at the end",
    "formation.settling_s": "from then on no follower is more than 5 cm off, to the end",
    "formation.overshoot": "how far z goes beyond zero, as share of the error at the start; the greatest",
    "formation.convergence_1_s": "rate at which |z| decays at the start; the slowest",
    "formation.hop_gain": "RMS of |z| over that of the leader's own link; above 1, errors grow along a chain",
    "formation.shape_changes": "how often leaders noted another shape",
    "formation.mode_toggles": "how often followers began to get around something, or had done so",
    "formation.avoid_s": "time that they spent so, added up",
    "formation.reformed_s": "from when the lane was free again until all were settled; the longest",
    "formation.shape.rms_m": "misfit of the centres and the shape, best turned and shifted; RMS over members and window",
    "formation.shape.max_m": "greatest misfit in the window",
    "formation.shape.final_m": "misfit at the end",
    "radio.frames": "frames that entered the channel",
    "radio.receptions": "frames received, at each receiver",
    "radio.delivery_ratio": "share of frames received, at each receiver",
    "radio.under_way": "frames still under way when the run ended, at each receiver",
    "radio.losses.*": "frames lost so, at each receiver",
    "radio.delay_s.mean": "from sending to reception, mean",
    "radio.delay_s.p50": "half of all delays are shorter",
    "radio.delay_s.p95": "95 % of all delays are shorter",
    "radio.delay_s.p99": "99 % of all delays are shorter",
    "radio.delay_s.max": "longest delay",
    "radio.age_s.mean": "age of what is known when agents act, mean over the window",
    "radio.age_s.p95": "95 % of these ages are less",
    "radio.age_s.max": "greatest of these ages",
    "radio.age_s.time_average": "mean age over all time in the window",
    "radio.age_s.peak": "mean of the age just before something newer arrives",
    "routing.messages": "messages of agents and programs",
    "routing.arrivals": "messages that arrived, at each receiver",
    "routing.delivery_ratio": "share of messages that arrived, at each receiver",
    "routing.hops_mean": "frames on the way of a message to a receiver, mean",
    "routing.hops_max": "frames on the longest way",
    "routing.delay_s.mean": "from the origin's sending to the arrival, mean",
    "routing.delay_s.p50": "half of all messages arrive sooner",
    "routing.delay_s.p95": "95 % of all messages arrive sooner",
    "routing.delay_s.p99": "99 % of all messages arrive sooner",
    "routing.delay_s.max": "longest from the origin's sending to the arrival",
    "routing.forwarded": "frames with messages that others than their origins sent",
    "routing.no_route": "messages that were not sent, because their origin knew no route",
    "routing.control_frames": "frames in which vehicles told of routes",
    "routing.control_bytes": "payload of these",
    "control.speed_rms_m_s": "root mean square of the speed, in the window",
    "control.yaw_rate_rms_rad_s": "root mean square of the yaw rate, in the window",
    "control.acceleration_rms_m_s2": "root mean square of the change of velocity from command to command",
    "control.yaw_acceleration_rms_rad_s2": "root mean square of the change of yaw rate from command to command",
    "control.effort_m2_s": "integral of the squared speed over the window, all vehicles together",
    "connectivity.mean": "algebraic connectivity, mean over the window: 0 in parts, 1 a star, N complete",
    "connectivity.min": "least algebraic connectivity",
    "connectivity.connected_share": "share of the seconds in which everybody is connected, over others or not",
    "safety.collisions": "touches of bodies that began; points without a body have none",
    "safety.min_separation_m": "smallest distance of two vehicles' centres",
    "safety.min_clearance_m": "smallest distance of a vehicle's reference point to an obstacle, in space",
    "mission.targets_found": "targets that a vehicle confirmed",
    "mission.targets_tracked": "targets that a vehicle tracked for 10 s on end",
    "mission.found_s.*": "when it was first confirmed",
    "mission.false_finds": "confirmations with no target near",
    "mission.area_seen_ratio": "share of the searched area that anybody has looked at",
    "mission.map_bytes_sent": "payload of all messages with maps",
    "mission.switches": "how often another algorithm took command of a vehicle",
    "hardware.*.age_s": "how old the newest was that its driver had told",
    "hardware.*.fix_age_s": "how old the last position was that counted",
    "hardware.*.sigma_m": "standard deviation of the estimated position, along its worse axis",
    "hardware.*.prediction_m": "how far off dead reckoning from one instant to the next was",
    "hardware.*.fixes": "positions that came",
    "hardware.*.gated": "positions that did not fit, and were left out",
    "hardware.*.reconnects": "how often its link was lost and came back",
    "hardware.*.stops": "how often it was stopped, by cause",
    "hardware.*.limited_s": "time in which it was told something else than its agent wanted",
    "hardware.*.limited_by_s": "of that, by cause; limits of speed and acceleration where nothing else held it back",
    "hardware.*.frames_too_early": "its frames that arrived earlier than any real link could",
    "agents.*.missed": "ticks at which the agent, lost or failed, did not act",
    "agents.*.lost_s": "simulated time for which it was lost",
    "agents.*.reconnects": "how often it came back, or another host in its place",
    "agents.*.late": "answers that came too late to count",
}
MANY = ("per_follower", "per_vehicle")  # tables of the same numbers, one for each vehicle


def number_tables(metrics: Mapping[str, Any]) -> Iterator[tuple[str, Sequence[Part]]]:
    """Title and content of each group of numbers that a run has, but for the faults of agents (`fault_table`)."""
    for group, (title, introduction) in GROUPS.items():
        if group not in metrics:
            continue
        found = metrics[group]
        parts: list[Part] = [Words(introduction)] if introduction else []
        if group == "hardware":
            parts += [_by_vehicle(group, found), *_explained(group, found)]
        else:
            parts += _table(group, found)
            parts += [_by_vehicle(group, found[name]) for name in MANY if found.get(name)]
        yield title, parts


def fault_table(agents: Mapping[str, Any]) -> Sequence[Part]:
    """Agents that missed something, and what; words where nobody did."""
    faulty = {vehicle: found for vehicle, found in agents.items() if any(found.values())}
    if not faulty:
        return [Words("No agent missed a tick, and none was late.")]
    return [_by_vehicle("agents", faulty), *_explained("agents", faulty)]


def _table(group: str, found: Mapping[str, Any]) -> Iterator[Part]:
    """The numbers that have a value, and the names of those that have none."""
    told = [(path, value) for path, value in flat(found) if value is not None]
    if told:
        rows = [[".".join(path), value, _unit_of((group, *path)), meaning_of((group, *path))] for path, value in told]
        yield Rows(["number", "value", "unit", "what it is"], rows)
    if untold := [".".join(path) for path, value in flat(found) if value is None]:
        yield Words(f"There was nothing to measure for {', '.join(untold)}.")


def flat(table: Mapping[str, Any], above: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Path and value of each number, but for those of each vehicle."""
    for name, value in table.items():
        if name in MANY:
            continue
        if isinstance(value, Mapping):
            yield from flat(value, (*above, name))
        else:
            yield (*above, name), value


def _by_vehicle(group: str, of: Mapping[str, Mapping[str, Any]]) -> Rows:
    """A row for each vehicle; numbers that nobody has are left out."""
    rows = {vehicle: dict(flat(each)) for vehicle, each in of.items()}
    paths = list(dict.fromkeys(path for each in rows.values() for path in each))
    told = [path for path in paths if any(each.get(path) is not None for each in rows.values())]
    units = [_unit_of((group, *path)) for path in told]
    head = [".".join(path) + (f" [{unit}]" if unit else "") for path, unit in zip(told, units, strict=True)]
    return Rows(["vehicle", *head], [[vehicle, *(each.get(path) for path in told)] for vehicle, each in rows.items()])


def _explained(group: str, of: Mapping[str, Mapping[str, Any]]) -> Sequence[Part]:
    """What the columns of a table by vehicle are."""
    names = dict.fromkeys(name for each in of.values() for name in each)
    return [Words("; ".join(f"{name}: {meaning_of((group, '*', name))}" for name in names) + ".")]


def _unit_of(path: Sequence[str]) -> str:
    """The unit that a name tells, or the nearest table that it is in: ``delay_s.mean`` is in s. Counts and shares have none."""
    for name in reversed(path):
        for suffix, words in UNITS.items():
            if name.endswith(f"_{suffix}"):
                return words
    return ""


def meaning_of(path: Sequence[str]) -> str:
    """What a number is, or the table that it is in; nothing where neither is known."""
    for length in range(len(path), 0, -1):
        for place in range(length, -1, -1):
            known = [*path[:length]]
            if place < length:
                known[place] = "*"
            if words := WORDS.get(".".join(known)):
                return words
    return ""
