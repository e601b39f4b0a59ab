"""What keys of a scenario's own tables mean, where the comments behind them do not say it by themselves."""

from collections.abc import Mapping

UNSAID: Mapping[str, Mapping[str, str]] = {
    "Scenario": {
        "name": "names the run and its folder",
        "duration_s": "simulated time; agents act at 0 <= t < duration",
        "seed": "all that is random depends on it, and on nothing else",
        "physics": "what moves the vehicles; Bullet, unless it says otherwise",
        "world": "what surrounds the vehicles; a floor, unless it says otherwise",
        "radio": "what carries their messages; the preset ideal, unless it says otherwise",
        "routing": "who passes on what others have sent; nobody, unless it says otherwise",
        "bridge": "programs as they are, at wall pace",
        "sockets": "programs that keep the run's own time",
        "agents": "where agents run, and defaults of their parameters",
        "clock": "how a run keeps to the wall clock",
        "safety": "what real vehicles keep to",
        "vehicles": "defaults for all vehicles, also of the parameters of their kinds",
        "record": "what is recorded",
        "metrics": "what is evaluated",
        "study": "what `vcmvsp study` varies",
        "intervention": "what an operator does during the run, planned beforehand",
        "vehicle": "one table for each vehicle, or for many with a `count`",
    },
    "AgentTable": {
        "runs": "where this one runs; default: agents.runs",
        "on_lost": "what becomes of its vehicle, or of the run, when it fails or its host is lost; default: agents.on_lost",
        "period_s": "between two ticks; default: agents.period_s, else the agent's own",
        "latency_s": "from an observation to the effect of the command; default: agents.latency_s",
    },
    "VehicleTable": {
        "name": "unique; letters, digits, _ and -",
        "kind": "what it is: one of those below, module:Class or file.py:Class",
        "pose": "x m, y m, yaw rad: where it starts, in place of `position` and `heading`; default: position and heading",
        "positioning": "the positioning system that its `pose_source` means; default: it has none",
        "agent": "what controls it; default: it stands still",
        "driver": "how the real vehicle is reached that takes its place; default: it is simulated",
        "localisation": "what tells where the real vehicle is; default: its odometry",
    },
    "RadioFederate": {
        "handover_s": (
            "where several vehicles send at one instant, and contend for the air, "
            "each message takes up to so long to reach the queue of its radio, uniformly"
        ),
    },
    "SetTable": {"value": "what it is then"},
    "StudyTable": {"vary": "key path (in quotes) = list of its values; all combinations are run"},
    "MetricsTable": {
        "from_s": "formation, ages, commands and connectivity are evaluated from here",
        "to_s": "to here, both included; default: the end",
    },
}
"""By class and key."""
