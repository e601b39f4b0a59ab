"""Text panels on the chosen vehicle and on the run: HTML made from `PageState` alone.

Texts from agents and hosts are escaped: they cannot add markup to a page.
"""

import math
from html import escape

import numpy as np

from vcmvsp.cosim.clock import SECOND_NS
from vcmvsp.cosim.util.text import plain
from vcmvsp.cosim.view.page.drawing import css_of
from vcmvsp.cosim.view.page.state import PageState
from vcmvsp.cosim.view.page.vehicles import errors_of

LINKS, LINES, NOTES = 12, 60, 12  # rows shown; of more, the count is shown
STATUS = "status", "mode", "task"  # names of the notes that say what a vehicle does
HEADINGS = "vehicle", "error [m]", "speed [m/s]", "message [s ago]", "status"
COMMANDING = "commander", "mode", "task"  # names of the notes that name a commander
LONGEST = 160  # maximum characters of an external text
LEVELS = {"warning": "#b8860b", "error": "#c92a2a", "fatal": "#c92a2a", "debug": "#868e96"}
BOX = "padding: 0.1em 0.75em 0.4em; font-size: 0.82em; line-height: 1.45"
Rows = list[tuple[str, str]]


def vehicle_page(state: PageState, row: int) -> str:
    """All data on a vehicle except curves and pictures."""
    if not state.names:
        return _boxed("There are no vehicles.")
    name = state.names[row]
    rows = [*_identity(state, row), *_motion(state, row), *_health(state, row)]
    parts = [_table(rows)]
    if notes := _notes(state, name):
        parts.append(_section("Noted by its agent", _table(notes)))
    if links := _links(state, row):
        parts.append(_section("Frames received of those sent, since the start", _table(links)))
    return _boxed("".join(parts))


SORTED = "name", "error", "speed", "age", "status"
"""Columns of `team_page` by which its rows can be sorted: the largest numbers first."""


def team_page(state: PageState, by: str) -> str:
    """A table of all vehicles, sorted by a column."""
    numbers = {"error": errors_of(state), "speed": state.speed, "age": state.age_s}
    statuses = [_status(state, name) for name in state.names]
    rows = list(range(len(state.names)))
    if by in numbers:
        rows = np.argsort(-np.nan_to_num(numbers[by], nan=-np.inf), kind="stable").tolist()
    elif by == "status":
        rows.sort(key=statuses.__getitem__)
    head = "".join(f"<th style='text-align: left; padding-right: 0.6em'>{name}</th>" for name in HEADINGS)
    body = []
    for row in rows:
        cells = _text(state.names[row]), *(_number(each[row]) for each in numbers.values()), _text(statuses[row])
        body.append(f"<tr><td>{'</td><td>'.join(cells)}</td></tr>")
    return _boxed(f"<table><tr>{head}</tr>{''.join(body)}</table>")


def _status(state: PageState, name: str) -> str:
    if name in state.now.halted:
        return "stopped"
    note = state.now.notes.get(name, {})
    return ", ".join(str(note[key]) for key in STATUS if note.get(key))


def _number(value: float) -> str:
    return f"{value:.3g}" if math.isfinite(value) else ""


def run_page(state: PageState) -> str:
    """Name, time and speed of the run."""
    scenery, pace = state.scenery, state.now.pace
    now, end = state.now.time_ns / SECOND_NS, scenery.duration_ns / SECOND_NS
    if pace.over:
        status = f'<span id="over">Run finished: {escape(plain(pace.over))}</span>'
    elif pace.waiting:
        status = f"waiting for {_text(pace.waiting)}"
    elif pace.paused:
        status = "paused"
    else:
        status = "running" if scenery.live else "recording"
        status += f" at {pace.speed:g}x" if pace.speed else " as fast as it can"
        status += f", reaches {pace.achieved:.2g}x" if pace.achieved is not None else ""
    rows = [
        ("scenario", f"{_text(scenery.scenario)}, seed {scenery.seed}"),
        ("time", f"<b>{now:.2f} s</b> of {end:g} s"),
        ("pace", status),
    ]
    return _boxed(_table(rows))


def log_page(state: PageState) -> str:
    """The log, the newest line first."""
    newest = list(state.lines)[: -LINES - 1 : -1]
    lines = "".join(
        f'<div style="color: {LEVELS.get(line.level, "inherit")}">'
        f'<span style="opacity: 0.6">{line.time_ns / SECOND_NS:.2f} s</span> {_text(line.text)}</div>'
        for line in newest
    )
    return _boxed(f'<div style="max-height: 12em; overflow-y: auto">{lines or "Nothing yet."}</div>')


def _identity(state: PageState, row: int) -> Rows:
    craft = state.scenery.vehicles[row]
    mark = f'<span style="color: {css_of(row)}; -webkit-text-stroke: 0.5px #888">&#9632;</span>'
    period = f", every {craft.period_s:g} s" if craft.period_s else ""
    note = state.now.notes.get(craft.name, {})
    commands = ", ".join(dict.fromkeys(_text(note[key]) for key in COMMANDING if note.get(key)))
    rows = [("vehicle", f"{mark} <b>{_text(craft.name)}</b>, {_text(craft.kind)}{', real' if craft.real else ''}")]
    rows.append(("agent", f"{_text(craft.agent)}{period}" if craft.agent else "none"))
    if commands:
        rows.append(("commands", f"<b>{commands}</b>"))
    follows = state.now.places.get(craft.name)
    if follows is not None and follows.leader is not None:
        rows.append(("follows", f"{_text(follows.leader)} at ({follows.slot[0]:.2f}, {follows.slot[1]:.2f}) m"))
    sightings = state.now.sightings.get(craft.name)
    if sightings is not None and sightings.found:
        texts = [
            f"{_text(each.target)} at ({each.place[0]:.1f}, {each.place[1]:.1f}) m, {each.score:.2f}"
            for each in sightings.found
        ]
        rows.append((f"recognised {max(state.now.time_ns - sightings.time_ns, 0) / SECOND_NS:.0f} s ago", "<br>".join(texts)))
    return rows


def _motion(state: PageState, row: int) -> Rows:
    x, y, z = (state.position[row].round(2) + 0.0).tolist()  # no -0.00
    if not math.isfinite(x):
        return [("position", "not known yet")]
    vx, vy, vz = state.velocity[row].tolist()
    yaw = round(float(state.yaw[row]), 2) + 0.0
    return [
        ("position", f"({x:.2f}, {y:.2f}, {z:.2f}) m"),
        ("speed", f"{math.hypot(vx, vy, vz):.2f} m/s"),
        ("yaw", f"{yaw:.2f} rad ({math.degrees(yaw) + 0.0:.0f}&deg;)"),
    ]


def _health(state: PageState, row: int) -> Rows:
    name, rows = state.names[row], []
    if name in state.now.halted:
        rows.append(("stopped", '<b style="color: #c92a2a">by the operator</b>'))
    presence = state.now.presence.get(name)
    if presence is not None:
        why = f": {_text(presence.why)}" if presence.why else ""
        rows.append(("presence", f"{presence.state} since {presence.since_ns / SECOND_NS:.2f} s{why}"))
    age_s = state.age_s[row]
    if math.isfinite(age_s):
        rows.append(("last message", f"{age_s:.2f} s ago"))
    status = state.now.real.get(name)
    if status is not None:
        if status.battery_v is not None:
            rows.append(("battery", f"{status.battery_v:.1f} V"))
        if status.age_s is not None:
            rows.append(("driver", f"told {status.age_s:.2f} s ago, connection {status.link}"))
        rows.append(("lateness", f"{1e3 * status.late_s:.0f} ms"))
        if status.causes:
            rows.append(("held back by", ", ".join(_text(each) for each in status.causes)))
    return rows


def _notes(state: PageState, name: str) -> Rows:
    notes = [(key, value) for key, value in state.now.notes.get(name, {}).items() if key not in COMMANDING]
    rows = [(_text(key), _noted(value)) for key, value in notes[:NOTES]]
    return rows + ([("...", f"and {len(notes) - NOTES} more")] if len(notes) > NOTES else [])


def _noted(value: float | str | bool) -> str:
    return f"{value:.4g}" if isinstance(value, float) else _text(value)


def _links(state: PageState, row: int) -> Rows:
    sent, received = state.now.sent, state.now.received
    if sent is None or received is None:
        return []
    to, back = sent[row], sent[:, row]
    others = [other for other in range(len(state.names)) if other != row and (to[other] or back[other])]
    receptions = received[row] + received[:, row]
    busiest = sorted(others, key=lambda other: (-int(receptions[other]), other))[:LINKS]
    rows = []
    for other in sorted(busiest):
        forth_share, back_share = _share(received[row, other], to[other]), _share(received[other, row], back[other])
        rows.append((_text(state.names[other]), f"to {forth_share}, from {back_share}"))
    return rows + ([("...", f"and {len(others) - LINKS} more")] if len(others) > LINKS else [])


def _share(received: int, sent: int) -> str:
    return f"{received}/{sent} ({100.0 * received / sent:.0f} %)" if sent else "none"


def _text(value: object) -> str:
    return escape(plain(str(value), LONGEST))


def paths_page(rows: Rows) -> str:
    """Paths of the wave: level and kinds."""
    return _boxed(_section("Paths, the strongest first", _table(rows)))


def _table(rows: Rows) -> str:
    cells = "".join(
        f'<tr><td style="opacity: 0.65; padding-right: 0.8em; vertical-align: top; white-space: nowrap">{name}</td>'
        f'<td style="overflow-wrap: anywhere">{value}</td></tr>'
        for name, value in rows
    )
    return f'<table style="border-spacing: 0">{cells}</table>'


def _section(title: str, content: str) -> str:
    return f'<div style="margin-top: 0.5em; font-weight: 600">{title}</div>{content}'


def _boxed(content: str) -> str:
    return f'<div style="{BOX}">{content}</div>'
