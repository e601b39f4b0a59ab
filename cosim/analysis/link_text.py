"""Text output of `cosim.analysis.links` for a terminal."""

from collections.abc import Container, Mapping, Sequence
from itertools import starmap
from typing import Any

from vcmvsp.cosim.util.text import aligned

Row = Mapping[str, Any]
_MATRIX = 12  # maximum number of vehicles in a matrix
_LINKS = 40  # maximum number of links in a table


def overview_text(rows: Sequence[Row], vehicles: Sequence[str]) -> str:
    """A matrix of delivery ratios, if it fits, and a table of links, the worst first."""
    parts = []
    if len(rows) > 1 and len(vehicles) <= _MATRIX:
        ratio = {(row["sender"], row["receiver"]): _percent(row["delivery_ratio"]) for row in rows}
        lines = [["from \\ to", *vehicles]]
        senders = {sender for sender, _ in ratio}
        for name in filter(senders.__contains__, vehicles):
            shares = [ratio.get((name, other), "-") for other in vehicles]
            lines.append([name, *shares])
        parts.append("delivered, %\n" + _table(lines, range(1, 1 + len(vehicles))))
    head = ["link", "frames", "delivered %", "distance m", "level dBm", "longest gap s", "lost to"]
    lines = [head]
    for row in rows[:_LINKS]:
        losses = ", ".join(f"{loss['frames']} {cause}" for cause, loss in row["losses"].items()) or "-"
        link = f"{row['sender']}/{row['receiver']}"
        figures = [_figure(row[name], digits) for name, digits in (("distance_m", 1), ("rssi_dbm", 1), ("longest_gap_s", 3))]
        lines.append([link, str(row["frames"]), _percent(row["delivery_ratio"]), *figures, losses])
    parts.append(_table(lines, range(1, 6)))
    if len(rows) > _LINKS:
        parts.append(f"... and {len(rows) - _LINKS} links with a higher share; --json prints all\n")
    return "\n".join(parts)


def link_text(link: Row) -> str:
    """Report of one link as text."""
    if not link["frames"]:
        return f"{link['sender']} -> {link['receiver']}: no frames\n"
    delivered = f"{link['received']} delivered"
    if link["delivery_ratio"] is not None:
        delivered += f" ({_percent(link['delivery_ratio'])} %)"
    lines = [["frames", f"{link['frames']}, {delivered}" + (f", {link['under_way']} under way" if link["under_way"] else "")]]
    for cause, loss in link["losses"].items():
        lines.append([f"  {cause}", f"{loss['frames']} ({_percent(loss['share'])} %)"])
    for name, key, unit in (("level", "rssi_dbm", "dBm"), ("SNR", "snr_db", "dB"), ("SINR", "sinr_db", "dB")):
        low, middle, high = (_figure(link[key][name], 1) for name in ("p5", "median", "p95"))
        lines.append([name, f"{middle} {unit} (median; 5 to 95 %: {low} to {high} {unit})"])
    distance, walls, receptions = link["distance_m"], link["walls"], link["receptions"]
    materials = ", ".join(f"{name} in {_percent(share)} %" for name, share in walls["materials"].items()) or "-"
    lines.append(["distance", f"{_figure(distance['min'], 2)} to {_figure(distance['max'], 2)} m"])
    lines.append(["path loss", f"{_figure(link['path_loss_db']['mean'], 1)} dB on average"])
    lines.append(["walls", f"{_figure(walls['loss_db'], 1)} dB on average ({materials})"])
    for name in ("shadowing", "fading"):
        of = link[f"{name}_db"]
        lines.append([name, f"{_figure(of['mean'], 1)} dB on average, standard deviation {_figure(of['sd'], 1)} dB"])
    for name in ("delay", "queue", "access"):
        values = [f"{key} {_milliseconds(value)}" for key, value in link[f"{name}_s"].items()]
        lines.append([name, ", ".join(values) + " ms"])
    gap_s, from_s = receptions["longest_gap_s"], receptions["gap_from_s"]
    lines.append(["longest gap", "-" if gap_s is None else f"{gap_s:.3f} s, from {from_s:.3f} s on"])
    lines.append(["received", f"first at {_figure(receptions['first_s'], 3)} s, last at {_figure(receptions['last_s'], 3)} s"])
    return f"{link['sender']} -> {link['receiver']}\n\n" + _table(lines, ())


def frame_text(frame: Row) -> str:
    """Budget and outcome of one frame as text."""
    budget = frame["budget"]
    gains = []
    if budget["tx_gain_dbi"] is not None:
        gains = [("antenna gains", budget["tx_gain_dbi"] + budget["rx_gain_dbi"], "dB", "")]
    quiet = "unknown" if budget["sinr_db"] is None else "none"
    items = [
        ("transmitted power" if gains else "power and antenna gains", budget["power_dbm"], "dBm", ""),
        *gains,
        ("path loss", budget["path_loss_db"], "dB", f"over {frame['distance_m']:.2f} m"),
        ("walls", budget["walls_db"], "dB", frame["wall_materials"]),
        ("shadowing", budget["shadowing_db"], "dB", ""),
        ("fading", budget["fading_db"], "dB", ""),
    ]
    if abs(budget["changes_db"]) > 1e-6:
        items.append(("antenna patterns, script or trace", budget["changes_db"], "dB", ""))
    items += [
        ("received level", budget["rssi_dbm"], "dBm", ""),
        ("noise", budget["noise_dbm"], "dBm", f"SNR {budget['snr_db']:.2f} dB"),
        ("interference", budget["interference_dbm"], "dBm", quiet if budget["interference_dbm"] is None else ""),
        ("SINR", budget["sinr_db"], "dB", ""),
    ]
    if budget["floor_dbm"] is not None:
        beside = f"the level is {abs(budget['margin_db']):.2f} dB {'above' if budget['margin_db'] >= 0.0 else 'below'} it"
        items.append((budget["floor"].removeprefix("the "), budget["floor_dbm"], "dBm", beside))
    lines = list(starmap(_item, items))
    head = f"frame {frame['frame']}, {frame['sender']} -> {frame['receiver']}, {frame['size_bytes']} bytes"
    text = f"{head}, sent at {frame['sent_s']:.3f} s\n\n{_table(lines, (1,))}\n{frame['why']}\n"
    return text + (_paths_text(frame["paths"]) if "paths" in frame else "")


_SHOWN_PATHS = 12


def _paths_text(paths: Sequence[Row]) -> str:
    """The strongest paths of rays with their levels."""
    rows = [["dBm", "delay ns", "path", "over (x, y, z) m"]]
    for path in paths[:_SHOWN_PATHS]:
        points = " ".join("({:.1f}, {:.1f}, {:.1f})".format(*point) for point in path["points"])
        rows.append([f"{path['level_dbm']:.2f}", f"{path['delay_ns']:.2f}", path["kinds"], points])
    more = f", the strongest {_SHOWN_PATHS}" if len(paths) > _SHOWN_PATHS else ""
    return f"\n{len(paths)} paths{more}:\n\n{_table(rows, (0, 1))}"


def _table(rows: Sequence[Sequence[str]], right: Container[int]) -> str:
    return "".join(f"{line}\n" for line in aligned(rows, right))


def _percent(share: float | None) -> str:
    return "-" if share is None else f"{100.0 * share:.1f}"


def _item(name: str, value: float | None, unit: str, note: str) -> list[str]:
    return [name, _figure(value, 2), "" if value is None else unit, note]


def _milliseconds(value_s: float | None) -> str:
    return "-" if value_s is None else f"{1e3 * value_s:.3f}"


def _figure(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{round(value, digits) + 0.0:.{digits}f}"  # no -0.0
