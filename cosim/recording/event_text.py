"""Text of events for the log of the recording and for the terminal."""

from collections.abc import Mapping

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Changed, Contact, Halted, Incident, Moved, Outage, Presence

TOLD = (Presence, Incident, Contact, Outage, Halted, Moved, Changed)
Told = Presence | Incident | Contact | Outage | Halted | Moved | Changed
_BECAME = {"lost": "has lost its agent", "removed": "is without an agent for good", "back": "has its agent again"}

_HELD_BY = {
    "geofence": "the fence",
    "separation": "others near it",
    "limits": "limits of speed and acceleration",
    "command": "no command",
    "positioning": "no position",
    "federation": "silence of the run",
    "operator": "silence of the operator",
    "clock": "its clock",
    "not_finite": "what is no number",
}
"""Words for the causes that limit a real vehicle; other causes are words already."""


def of_limits(by_s: Mapping[str, float]) -> str:
    """Causes that limited a real vehicle and for how long, the longest first."""
    longest = sorted(by_s.items(), key=lambda item: -item[1])
    return ", ".join(f"{_HELD_BY.get(cause, cause)} {held_s:.1f} s" for cause, held_s in longest)


def of_event(vehicle: str, event: Told, time_ns: int) -> tuple[str, str]:
    """Log level and text of an event: a lost agent, an incident, a contact, or an operator's action."""
    match event:
        case Presence():
            why = f": {event.why}" if event.why else ""
            return "info" if event.state == "back" else "warning", f"{vehicle} {_BECAME[event.state]}{why}"
        case Incident():
            return "info" if event.what == "connected" else "warning", f"{vehicle} {event.what}: {event.cause}"
        case Contact():
            return "warning", f"{event.vehicle} touches {event.other or 'something that stands still'}"
        case Outage():
            text = f"no radio for {', '.join(event.vehicles)} for {(event.until_ns - time_ns) / SECOND_NS:g} s"
        case Halted():
            text = f"{', '.join(event.vehicles)} {'halted' if event.halted else 'let go'}"
        case Moved():
            text = f"{event.obstacle} moved to ({event.position[0]:g}, {event.position[1]:g}) m, {event.yaw:g} rad"
        case Changed():
            text = f"{event.key} = {event.value:g}"
    return "info", f"operator: {text}"
