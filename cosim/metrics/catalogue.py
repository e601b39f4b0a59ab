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
METRICS = {  # ``*`` stands for a name
    "formation.rms_m": Metric("root mean square of |z| over followers and window", label="formation error, RMS"),
    "formation.mean_m": Metric("mean of |z| over followers and window", label="formation error, mean"),
    "formation.max_m": Metric("greatest |z| in the window", label="formation error, greatest"),
    "formation.final_m": Metric("greatest |z| at the end", label="formation error at the end"),
    "formation.settling_s": Metric(
        "from then on no follower is more than 5 cm off, to the end", "No value: one of them is.", "settled after"
    ),
    "formation.overshoot": Metric(
        "how far z goes beyond zero, as share of the error at the start; the greatest",
        "Of a follower's largest step: the time with one place that begins with the greatest error. No value: within 5 cm.",
    ),
    "formation.convergence_1_s": Metric(
        "rate at which |z| decays at the start; the slowest",
        "In the same step, by least squares of the logarithm until 5 % of the start, or twice the RMS of its last fifth.",
    ),
    "formation.hop_gain": Metric(
        "RMS of |z| over that of the leader's own link; above 1, errors grow along a chain",
        "In the window; the greatest. No value: nobody follows a follower.",
    ),
    "formation.shape_changes": Metric(
        "how often leaders noted another shape",
        "Leaders are followed and never follow. Of one follower: how often it did.",
    ),
    "formation.mode_toggles": Metric(
        "how often followers began to get around something, or had done so", "By their notes: `mode` is `avoid` or `turn`."
    ),
    "formation.avoid_s": Metric("time that they spent so, added up", "No value, for this and the last: nobody notes modes."),
    "formation.reformed_s": Metric(
        "from when the lane was free again until all were settled; the longest",
        "By the notes of a team's leader, to the end of the run. No value: the lane was never `narrow`, or is to the end; the "
        "team keeps the shape that it took when it was; or one is off.",
    ),
    "formation.shape.rms_m": Metric(
        "misfit of the centres and the shape, best turned and shifted; RMS over members and window",
        "The shape: slots added up from the first of all who are connected by following. Headings are taken as equal: on a "
        "circle the shape bends although z is 0.",
    ),
    "formation.shape.max_m": Metric("greatest misfit in the window"),
    "formation.shape.final_m": Metric("misfit at the end"),
    "radio.frames": Metric("frames that entered the channel"),
    "radio.receptions": Metric("frames received, at each receiver"),
    "radio.delivery_ratio": Metric(
        "share of frames received, at each receiver", "Of what was received or lost.", "share of frames delivered"
    ),
    "radio.under_way": Metric("frames still under way when the run ended, at each receiver"),
    "radio.losses.*": Metric("frames lost so, at each receiver", "By cause."),
    "radio.delay_s.mean": Metric("from sending to reception, mean", label="delay, mean"),
    "radio.delay_s.p50": Metric("half of all delays are shorter"),
    "radio.delay_s.p95": Metric("95 % of all delays are shorter"),
    "radio.delay_s.p99": Metric("99 % of all delays are shorter"),
    "radio.delay_s.max": Metric("longest delay"),
    "radio.age_s.mean": Metric(
        "age of what is known when agents act, mean over the window",
        "Of the newest message of a follower's leader; without followers, of every link.",
        "age of information, mean",
    ),
    "radio.age_s.p95": Metric("95 % of these ages are less", label="age of information, 95th percentile"),
    "radio.age_s.max": Metric("greatest of these ages", label="age of information, greatest"),
    "radio.age_s.time_average": Metric(
        "mean age over all time in the window", "d + T (1 + p)/(2 (1 - p)) at delay d, period T, independent losses p."
    ),
    "radio.age_s.peak": Metric("mean of the age just before something newer arrives", "In the window; likewise d + T/(1 - p)."),
    "routing.messages": Metric("messages of agents and programs", "This and the others only with routing."),
    "routing.arrivals": Metric("messages that arrived, at each receiver", "Where they were meant to arrive."),
    "routing.delivery_ratio": Metric(
        "share of messages that arrived, at each receiver", "Without what may still arrive when the run ends."
    ),
    "routing.hops_mean": Metric("frames on the way of a message to a receiver, mean"),
    "routing.hops_max": Metric("frames on the longest way"),
    "routing.delay_s.mean": Metric("from the origin's sending to the arrival, mean"),
    "routing.delay_s.p50": Metric("half of all messages arrive sooner"),
    "routing.delay_s.p95": Metric("95 % of all messages arrive sooner"),
    "routing.delay_s.p99": Metric("99 % of all messages arrive sooner"),
    "routing.delay_s.max": Metric("longest from the origin's sending to the arrival"),
    "routing.forwarded": Metric("frames with messages that others than their origins sent"),
    "routing.no_route": Metric("messages that were not sent, because their origin knew no route"),
    "routing.control_frames": Metric("frames in which vehicles told of routes"),
    "routing.control_bytes": Metric("payload of these"),
    "control.speed_rms_m_s": Metric("root mean square of the speed, in the window", "Way-points are not counted."),
    "control.yaw_rate_rms_rad_s": Metric("root mean square of the yaw rate, in the window"),
    "control.acceleration_rms_m_s2": Metric(
        "root mean square of the change of velocity from command to command", "Over the time between them, in the window."
    ),
    "control.yaw_acceleration_rms_rad_s2": Metric(
        "root mean square of the change of yaw rate from command to command", "Likewise."
    ),
    "control.effort_m2_s": Metric("integral of the squared speed over the window, all vehicles together"),
    "connectivity.mean": Metric(
        "algebraic connectivity, mean over the window: 0 in parts, 1 a star, N complete",
        "A graph for each second. No value: one vehicle alone, more than 200, or less than a second.",
    ),
    "connectivity.min": Metric("least algebraic connectivity"),
    "connectivity.connected_share": Metric("share of the seconds in which everybody is connected, over others or not"),
    "safety.collisions": Metric("touches of bodies that began; points without a body have none"),
    "safety.min_separation_m": Metric(
        "smallest distance of two vehicles' centres", "At recorded instants.", "smallest distance of two vehicles"
    ),
    "safety.min_clearance_m": Metric(
        "smallest distance of a vehicle's reference point to an obstacle, in space",
        "At recorded instants, to solids and `moving` obstacles: above a wall it is the height, inside it 0. Movables and the "
        "floor do not count. No value: there is nothing else.",
        "smallest distance to an obstacle",
    ),
    "mission.targets_found": Metric("targets that a vehicle confirmed", "By a note `found`, by the target's name or none."),
    "mission.targets_tracked": Metric(
        "targets that a vehicle tracked for 10 s on end", "Within 3 m, while its `task` was to track them."
    ),
    "mission.found_s.*": Metric("when it was first confirmed", "No value: never."),
    "mission.false_finds": Metric("confirmations with no target near"),
    "mission.area_seen_ratio": Metric("share of the searched area that anybody has looked at", "No value: nobody shows a map."),
    "mission.map_bytes_sent": Metric("payload of all messages with maps", unit="bytes"),
    "mission.switches": Metric("how often another algorithm took command of a vehicle"),
    "agents.*.missed": Metric("ticks at which the agent, lost or failed, did not act"),
    "agents.*.lost_s": Metric("simulated time for which it was lost", "See `on_lost`."),
    "agents.*.reconnects": Metric("how often it came back, or another host in its place"),
    "agents.*.late": Metric("answers that came too late to count"),
    "hardware.*.age_s": Metric("how old the newest was that its driver had told", "At the instants of the run: p50, p99, max."),
    "hardware.*.fix_age_s": Metric("how old the last position was that counted", "Likewise."),
    "hardware.*.sigma_m": Metric("standard deviation of the estimated position, along its worse axis", "Likewise."),
    "hardware.*.prediction_m": Metric("how far off dead reckoning from one instant to the next was", "Likewise."),
    "hardware.*.fixes": Metric("positions that came"),
    "hardware.*.gated": Metric("positions that did not fit, and were left out"),
    "hardware.*.reconnects": Metric("how often its link was lost and came back"),
    "hardware.*.stops": Metric("how often it was stopped, by cause"),
    "hardware.*.limited_s": Metric("time in which it was told something else than its agent wanted"),
    "hardware.*.limited_by_s": Metric("of that, by cause; limits of speed and acceleration where nothing else held it back"),
    "hardware.*.frames_too_early": Metric(
        "its frames that arrived earlier than any real link could", "After a delay below its own median age."
    ),
}


def metric_of(path: Sequence[str]) -> Metric:
    """The catalogue entry of a metric or of its table; empty if both are unknown."""
    for length in range(len(path), 0, -1):
        for place in range(length, -1, -1):
            name = ".".join("*" if at == place else part for at, part in enumerate(path[:length]))
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
