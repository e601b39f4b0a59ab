"""Events that a person wants to be told of, in words: for the log of the recording, and for the terminal."""

from collections.abc import Mapping

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.types import Changed, Contact, Halted, Incident, Moved, Outage, Presence

Intervention = Outage | Halted | Moved | Changed
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
"""Causes for which a real vehicle is held back; others are words already."""


def of_limits(by_s: Mapping[str, float]) -> str:
    """What held a real vehicle back, and for how long each, the longest first."""
    longest = sorted(by_s.items(), key=lambda item: -item[1])
    return ", ".join(f"{_HELD_BY.get(cause, cause)} {held_s:.1f} s" for cause, held_s in longest)


def of_presence(vehicle: str, presence: Presence) -> tuple[str, str]:
    """Level of the log and text: what became of an agent."""
    text = f"{vehicle} {_BECAME[presence.state]}" + (f": {presence.why}" if presence.why else "")
    return "info" if presence.state == "back" else "warning", text


def of_incident(vehicle: str, incident: Incident) -> tuple[str, str]:
    """Likewise: what befell a real vehicle."""
    return "info" if incident.what == "connected" else "warning", f"{vehicle} {incident.what}: {incident.cause}"


def of_contact(contact: Contact) -> tuple[str, str]:
    """Likewise: what a vehicle touches."""
    return "warning", f"{contact.vehicle} touches {contact.other or 'something that stands still'}"


def of_intervention(done: Intervention, time_ns: int) -> tuple[str, str]:
    """Likewise: what the operator did."""
    match done:
        case Outage():
            text = f"no radio for {', '.join(done.vehicles)} for {(done.until_ns - time_ns) / SECOND_NS:g} s"
        case Halted():
            text = f"{', '.join(done.vehicles)} {'halted' if done.halted else 'let go'}"
        case Moved():
            text = f"{done.obstacle} moved to ({done.position[0]:g}, {done.position[1]:g}) m, {done.yaw:g} rad"
        case Changed():
            text = f"{done.key} = {done.value:g}"
    return "info", f"operator: {text}"
