"""The numbers of a run: name, unit, meaning and label of each, for reports, figures of studies and the reference of keys.

The schema ``vcmvsp.metrics/1``, as `Recorder.metrics` gives it. Metrics may be added to it; none changes its meaning. Which
there are depends on the scenario and not on chance, but for the causes of losses. Where there is nothing to measure a value is
None, never NaN. Besides these a run tells ``schema``, ``scenario``, ``seed``, ``duration_s`` (simulated time that it lasted)
and ``digest`` (SHA-256 of all that was recorded).
"""

from collections.abc import Sequence
from typing import NamedTuple

SCHEMA = "vcmvsp.metrics/1"
MANY = ("per_follower", "per_vehicle")  # tables of the same numbers, one for each vehicle
UNITS = {  # by the ends of names, longest first
    "m_s2": "m/s²", "rad_s2": "rad/s²", "m2_s": "m²/s", "m_s": "m/s", "rad_s": "rad/s", "1_s": "1/s", "s": "s", "m": "m",
    "hz": "Hz", "dbm": "dBm", "db": "dB", "rad": "rad", "deg": "degrees", "kg": "kg", "seconds": "s", "bytes": "bytes",
    "j": "J",
}  # fmt: skip


class Metric(NamedTuple):
    """A number of a run."""

    meaning: str  # one line
    details: str = ""  # how it is computed, and when it has no value
    label: str = ""  # axis label without unit, if the name is unclear
    unit: str = ""  # if the name has none


GROUPS = {
    "formation": (
        "Formation",
        "The error z of a follower is the distance of its handle, a point ahead of its centre, from its place in the frame of "
        "its leader, m. All poses are true poses, not estimates.",
    ),
    "radio": ("Radio", "A frame counts once for each addressed vehicle. Ages are of the newest message received."),
    "routing": ("Routing", "A message counts once for each addressed vehicle, whichever way it took."),
    "control": ("Commands", "Commanded velocities; a command holds until the next one."),
    "connectivity": ("Connectivity", "Vehicles are connected if either received a frame of the other within a second."),
    "energy": ("Energy", "Of the vehicles with a battery."),
    "safety": ("Safety", ""),
    "mission": ("Mission", "A find counts if the true place of a target is within 3 m."),
    "hardware": ("Real vehicles", ""),
    "own": ("Own metrics", "As the scenario defines them in [metrics.own]."),
}
"""Title and introduction of each group of numbers; failures of agents have a section of their own."""
METRICS = {  # ``*`` stands for a name
    "formation.rms_m": Metric("root mean square of |z| over all followers and the window", label="formation error, RMS"),
    "formation.mean_m": Metric("mean of |z| over all followers and the window", label="formation error, mean"),
    "formation.max_m": Metric("greatest |z| in the window", label="formation error, greatest"),
    "formation.final_m": Metric("greatest |z| at the end", label="formation error at the end"),
    "formation.settling_s": Metric(
        "time after which |z| of all followers stays within 5 cm", "No value: never within 5 cm to the end.", "settled after"
    ),
    "formation.overshoot": Metric(
        "overshoot of z beyond zero, as a fraction of the initial error; the greatest",
        "Over a follower's largest step: the stretch with one place and the greatest initial error. No value: never over 5 cm.",
    ),
    "formation.convergence_1_s": Metric(
        "initial rate of decay of |z|; the slowest",
        "Over the same step: least squares of log |z| down to 5 % of its start, or to twice the RMS of the last fifth.",
    ),
    "formation.hop_gain": Metric(
        "RMS of |z| divided by that of the leader's own link; above 1, errors grow along a chain",
        "In the window; the greatest. No value: no follower has a follower as leader.",
    ),
    "formation.shape_changes": Metric(
        "number of changes of shape, by notes of the leaders",
        "Leaders: vehicles that others follow and that follow none. Per follower: by its own notes.",
    ),
    "formation.mode_toggles": Metric(
        "number of starts and ends of avoidance by followers", "Avoidance: the note `mode` is `avoid` or `turn`."
    ),
    "formation.avoid_s": Metric("total time of followers in avoidance", "No value, here and above: no vehicle notes `mode`."),
    "formation.reformed_s": Metric(
        "time from the end of a narrow lane until all followers have settled; the longest",
        "By the notes of a team's leader. No value: the lane was never `narrow`, or was to the end of the run; the team never "
        "took its shape again; or a follower never settled.",
    ),
    "formation.shape.rms_m": Metric(
        "distance of the centres from the best-fitting rotated and shifted shape; RMS over members and the window",
        "The shape is the sum of slots along the chains of leaders, with equal headings: on a circle the misfit is not 0, "
        "although z is 0.",
    ),
    "formation.shape.max_m": Metric("greatest misfit in the window"),
    "formation.shape.final_m": Metric("misfit at the end"),
    "radio.frames": Metric("frames that entered the channel"),
    "radio.receptions": Metric("frames received, at each receiver"),
    "radio.delivery_ratio": Metric(
        "share of frames received, at each receiver", "Of all frames received or lost.", "share of frames delivered"
    ),
    "radio.under_way": Metric("frames neither received nor lost at the end of the run, at each receiver"),
    "radio.losses.*": Metric("frames lost, at each receiver, by cause"),
    "radio.delay_s.mean": Metric("mean delay from sending to reception", label="delay, mean"),
    "radio.delay_s.p50": Metric("median delay"),
    "radio.delay_s.p95": Metric("95th percentile of the delays"),
    "radio.delay_s.p99": Metric("99th percentile of the delays"),
    "radio.delay_s.max": Metric("longest delay"),
    "radio.age_s.mean": Metric(
        "mean age of the newest message when agents act, over the window",
        "Messages of a follower's leader; without followers, of all links.",
        "age of information, mean",
    ),
    "radio.age_s.p95": Metric("95th percentile of these ages", label="age of information, 95th percentile"),
    "radio.age_s.max": Metric("greatest of these ages", label="age of information, greatest"),
    "radio.age_s.time_average": Metric(
        "mean age over all time in the window", "Theory: d + T (1 + p)/(2 (1 - p)) for delay d, period T, independent loss p."
    ),
    "radio.age_s.peak": Metric("mean age just before a newer message arrives, in the window", "Theory: d + T/(1 - p)."),
    "routing.messages": Metric("messages of agents and programs", "All of this group: only with routing."),
    "routing.arrivals": Metric("messages that arrived, at each addressed receiver"),
    "routing.delivery_ratio": Metric(
        "share of messages that arrived, at each receiver", "Without messages still under way at the end of the run."
    ),
    "routing.hops_mean": Metric("mean number of hops of a message to a receiver"),
    "routing.hops_max": Metric("largest number of hops"),
    "routing.delay_s.mean": Metric("mean delay from the origin to the receiver"),
    "routing.delay_s.p50": Metric("median of these delays"),
    "routing.delay_s.p95": Metric("95th percentile of these delays"),
    "routing.delay_s.p99": Metric("99th percentile of these delays"),
    "routing.delay_s.max": Metric("longest of these delays"),
    "routing.forwarded": Metric("frames that forward a message of another vehicle"),
    "routing.no_route": Metric("messages not sent because their origin had no route"),
    "routing.control_frames": Metric("frames of the routing protocol itself"),
    "routing.control_bytes": Metric("payload of these frames"),
    "control.speed_rms_m_s": Metric("root mean square of the commanded speed, in the window", "Without waypoints."),
    "control.yaw_rate_rms_rad_s": Metric("root mean square of the commanded yaw rate, in the window"),
    "control.acceleration_rms_m_s2": Metric(
        "root mean square of the change of velocity between commands, divided by the time between them, in the window"
    ),
    "control.yaw_acceleration_rms_rad_s2": Metric(
        "root mean square of the change of yaw rate between commands, divided by the time between them, in the window"
    ),
    "control.effort_m2_s": Metric("integral of the squared speed over the window, all vehicles together"),
    "connectivity.mean": Metric(
        "mean algebraic connectivity over the window: 0 disconnected, 1 a star, N complete",
        "One graph per second. No value: a single vehicle, more than 200 vehicles, or less than a second.",
    ),
    "connectivity.min": Metric("least algebraic connectivity"),
    "connectivity.connected_share": Metric("share of seconds with a connected graph (directly or over other vehicles)"),
    "energy.*.charge_left": Metric("charge at the end as a share of the capacity"),
    "energy.*.used_j": Metric("energy taken from the battery"),
    "energy.*.motion_j": Metric("energy for the motion"),
    "energy.*.radio_j": Metric("additional energy for sending and receiving"),
    "energy.*.empty_s": Metric("time at which the battery was empty", "No value: never."),
    "safety.collisions": Metric("contacts of vehicles with vehicles or obstacles; points without a body have none"),
    "safety.min_separation_m": Metric(
        "smallest distance of the centres of two vehicles", "At recorded instants.", "smallest distance of two vehicles"
    ),
    "safety.min_clearance_m": Metric(
        "smallest 3D distance of a vehicle's reference point to an obstacle",
        "At recorded instants, to solids and `moving` obstacles: above a wall the height over it, inside it 0. Movables and "
        "the floor do not count. No value: no obstacle.",
        "smallest distance to an obstacle",
    ),
    "mission.targets_found": Metric("targets confirmed by a vehicle", "By the note `found`: a target's name, or none."),
    "mission.targets_tracked": Metric("targets tracked for 10 s without a break", "Within 3 m, with the `task` to track."),
    "mission.found_s.*": Metric("time at which the target was first confirmed", "No value: never."),
    "mission.false_finds": Metric("confirmations without a target within 3 m"),
    "mission.area_seen_ratio": Metric("share of the search area that vehicles have seen", "No value: no vehicle shows a map."),
    "mission.map_bytes_sent": Metric("payload of all map messages", unit="bytes"),
    "mission.switches": Metric("number of changes of the commanding algorithm"),
    "agents.*.missed": Metric("ticks without an action of the agent (lost or failed)"),
    "agents.*.lost_s": Metric("simulated time without the agent", "See `on_lost`."),
    "agents.*.reconnects": Metric("number of returns of the agent, on its own host or another"),
    "agents.*.late": Metric("answers after the deadline, which are ignored"),
    "hardware.*.age_s": Metric("age of the newest measurement of its driver", "At the instants of the run: p50, p99, max."),
    "hardware.*.fix_age_s": Metric("age of the last accepted position", "p50, p99, max."),
    "hardware.*.sigma_m": Metric("standard deviation of the estimated position, along its worse axis", "p50, p99, max."),
    "hardware.*.prediction_m": Metric("error of dead reckoning from one instant to the next", "p50, p99, max."),
    "hardware.*.fixes": Metric("positions received"),
    "hardware.*.gated": Metric("positions rejected because they did not fit the estimate"),
    "hardware.*.reconnects": Metric("number of losses of its link after which it came back"),
    "hardware.*.stops": Metric("number of stops, by cause"),
    "hardware.*.limited_s": Metric("time with a command other than its agent's"),
    "hardware.*.limited_by_s": Metric("that time by cause; limits of speed and acceleration only without another cause"),
    "hardware.*.frames_too_early": Metric(
        "received frames that no real link could have delivered in time", "Delay below the vehicle's own median age."
    ),
    "own.*": Metric(
        "as the scenario defines it in `[metrics.own]`",
        "The end of its name gives the unit. No value: nothing to measure, or the metric failed.",
    ),
}


def metric_of(path: Sequence[str]) -> Metric:
    """The catalogue entry of a metric or of its table; empty if both are unknown."""
    for length in range(len(path), 0, -1):
        for place in range(length, -1, -1):
            name = ".".join([*path[:place], "*", *path[place + 1 : length]] if place < length else path[:length])
            if name in METRICS:
                return METRICS[name]
    return Metric("")


def unit_of(path: Sequence[str]) -> str:
    """Unit in a metric's name or in the nearest table above it: ``delay_s.mean`` is in s. Counts and shares have none."""
    return metric_of(path).unit or next((unit for name in reversed(path) if (unit := split_unit(name)[1])), "")


def split_unit(name: str) -> tuple[str, str]:
    """Split a name into the name without unit, and the unit; empty if it has none."""
    for end, unit in UNITS.items():
        stem = name.removesuffix(f"_{end}")
        if stem not in (name, "") and not stem.isdigit():
            return stem, unit
    return name, UNITS.get(name, "")
