"""Writes ``report.html`` of a run: the content of its folder in one file. The page names what is missing.

Equal runs have equal pages except the last section, which describes the machine, as ``about.json`` does.
"""

import shlex
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import starmap
from pathlib import Path
from typing import Any

from vcmvsp.cosim.errors import words_of
from vcmvsp.cosim.report.page import Code, Facts, Figure, Part, Rows, Section, Words, counted, page
from vcmvsp.cosim.report.run_folder import FILES, RunContent, content_of
from vcmvsp.cosim.report.tables import expectation_table, fault_table, link_table, loss_table, number_tables, vehicle_table
from vcmvsp.cosim.util.files import write_whole

FILE = "report.html"
MACHINE = "Machine"  # title of the only section that differs between equal runs
FIGURES = {
    "trajectory": "Tracks from above, with the formation at a few instants.",
    "formation_error": "Formation error, age of the followers' information about their leaders, and frames lost.",
    "mission": "Commander of each vehicle over time, targets found, and the shared map at four instants.",
    "mosaic": "Mosaic of the ground, from the pictures of all vehicles, and places of recognised targets.",
    "detections": "Pictures with recognised targets.",
}
HOST = {"name": "host", "system": "system", "python": "python"}
LATENESS = {
    "speed": "simulated seconds per second",
    "instants": "instants at which agents acted",
    "p50_s": "median [s]",
    "p99_s": "99th percentile [s]",
    "max_s": "latest [s]",
    "over_one_period": "late by more than a period",
    "slipped_s": "the run slipped by [s]",
}
BRIDGE = {
    **LATENESS,
    "delivered": "deliveries to programs",
    "lost": "datagrams lost on the channel, counted for each receiver",
    "over_1ms": "late by more than 1 ms",
}
TOLD = 500  # log lines shown


def write(folder: Path, drawings: Mapping[str, str], out: Path | None = None) -> Path:
    """Write the page of a run into its folder, or to ``out``; ``drawings`` are its figures as SVG text, by name.

    Raises:
        UsageError: the folder contains no files of a run.
    """
    path = out or folder / FILE
    write_whole(path, _page_of(content_of(folder), drawings))
    return path


def _page_of(content: RunContent, drawings: Mapping[str, str]) -> str:
    """Build the page; on an error, without metrics and facts, which another version may have written."""
    try:
        return run_page(content, drawings)
    except (LookupError, TypeError, ValueError, AttributeError) as error:
        why = f"cannot be shown: {words_of(error)}"
        missing = [*content.missing, *((name, why) for name in ("metrics.json", "about.json"))]
        return run_page(replace(content, metrics={}, about={}, missing=missing), drawings)


def run_page(content: RunContent, drawings: Mapping[str, str]) -> str:
    """The page as HTML."""
    figures = [Figure(svg, FIGURES.get(name, name)) for name, svg in drawings.items()]
    sections = [
        Section("What is missing", _missing(content)),
        Section("Figures", figures),
        Section("Expected and measured", expectation_table(content)),
        *starmap(Section, number_tables(content.metrics)),
        Section("Vehicles", vehicle_table(content)),
    ]
    if content.links is not None:
        sections.append(Section("Links", link_table(content.links)))
        sections.append(Section("What was lost, and why", loss_table(content.links, content.folder)))
    sections.append(Section("Agents and incidents", list(_incidents(content))))
    sections.append(Section("Again", list(_again(content))))
    if content.scenario_toml:
        sections.append(Section("Scenario", [Code(content.scenario_toml, folded="with everything filled in")]))
    sections.append(Section(MACHINE, list(_machine(content.about))))
    return page(_title(content), " ".join(_sentences(content)), [each for each in sections if each.parts])


def _missing(content: RunContent) -> list[Part]:
    if not content.missing:
        return []
    rows = [[name, why, FILES[name]] for name, why in content.missing]
    parts: list[Part] = [Rows(["file", "", "what it would tell"], rows)]
    if content.recorded_s is not None:
        cut = "The run was cut before its tables were written, or they are gone."
        parts.append(Words(f"{cut} Its recording, run.mcap, goes to {content.recorded_s:g} s."))
    return parts


def _incidents(content: RunContent) -> Iterator[Part]:
    if "agents" in content.metrics:
        yield from fault_table(content.metrics["agents"])
    if error := content.about.get("error"):
        yield Words(f"What ended the run: {error['message']}")
        if error.get("details"):
            yield Code(error["details"], folded="details")
    if content.log:
        yield Rows(["time [s]", "", "what"], [[time_s, level, text] for time_s, level, text in content.log[:TOLD]])
        if len(content.log) > TOLD:
            yield Words(f"And {len(content.log) - TOLD} more lines, in run.mcap.")


def _again(content: RunContent) -> Iterator[Part]:
    if not content.scenario_toml:
        return
    yield Words("In this folder:")
    lines = [f"vcmvsp run scenario.toml --out again    # {_repetition(content)}"]
    if (content.folder / "hardware.mcap").is_file():
        lines = ["vcmvsp replay .    # what happened, again; no real vehicle moves"]
    if content.links is not None and content.links.losses:
        a, b = next(pair for pair in content.links.pairs if content.links.lost_to(*pair))
        link = shlex.quote(f"{content.links.names[a]}/{content.links.names[b]}")
        lines.append(f"vcmvsp radio . --link {link} --frame lost    # why a frame was lost")
    yield Code("\n".join(lines))
    if "digest" in content.metrics:
        window = content.scenario.get("metrics", {})
        until = f"to {window['to_s']:g} s" if "to_s" in window else "to the end"
        yield Facts(
            [
                ("seed", content.metrics.get("seed")),
                ("digest of all that was recorded", content.metrics["digest"]),
                ("window of the numbers", f"{window.get('from_s', 0.0):g} s {until}"),
            ]
        )


def _repetition(content: RunContent) -> str:
    if content.about.get("error"):
        return "from the start"
    differs = "; ".join(map(str, content.about.get("unrepeatable", ())))
    return f"differs: {differs}" if differs else "the same run: the digest is the same"


def _machine(about: Mapping[str, Any]) -> Iterator[Part]:
    if not about:
        return
    host, late = about.get("host", {}), about.get("lateness")
    facts: list[tuple[str, Any]] = [("started", about.get("started"))]
    if about.get("simulating_s"):
        took_s, simulated_s = about["simulating_s"], about["simulated_s"]
        facts.append(("took", f"{took_s:.3g} s for {simulated_s:g} s simulated, {simulated_s / took_s:.3g}x real time"))
    facts += [(words, host[name]) for name, words in HOST.items() if name in host]
    for where in sorted(set(about.get("agents", {}).values())):
        names = [name for name, place in about["agents"].items() if place == where]
        facts.append((f"agents: {where}", ", ".join(names)))
    facts += [(name, version) for name, version in about.get("versions", {}).items()]
    yield Facts(facts)
    if late:
        yield Words("How late instants began on the wall clock:")
        yield Facts([(LATENESS.get(name, name), value) for name, value in late.items()])
    if carried := about.get("bridge"):
        yield Words("What the bridge carried for programs outside, and how late it left:")
        numbers = {name: value for name, value in carried.items() if name != "counts"}
        yield Facts([(BRIDGE.get(name, name), value) for name, value in numbers.items()])
        rows = [[name, cause, number] for name, counts in carried["counts"].items() for cause, number in counts.items()]
        if rows:
            yield Rows(["vehicle", "not carried", "datagrams"], rows)
    if about.get("cuts_s"):
        yield Words("How long hosts of agents were cut off, s:")
        yield Facts([(name, str(value)) for name, value in about["cuts_s"].items()])


def _title(content: RunContent) -> str:
    facts = content.metrics or content.scenario or content.head
    name = facts.get("scenario") or facts.get("name") or "A run"
    seed = facts.get("seed")
    return str(name) if seed is None else f"{name}, seed {seed}"


def _sentences(content: RunContent) -> Iterator[str]:
    yield _summary(content)
    if error := content.about.get("error"):
        yield f"It ended before its time: {error['message'].rstrip('.')}."
    if not content.metrics:
        yield "It has left no numbers."
        return
    metrics = content.metrics
    yield from radio_sentences(metrics["radio"])
    yield from _formation(metrics["formation"])
    if mission := metrics.get("mission"):
        yield from _mission(mission)
    yield from _safety(metrics)


def _summary(content: RunContent) -> str:
    names = content.recording.facts.vehicles if content.recording else content.head.get("vehicles", "").split()
    vehicles = len(names or content.scenario.get("vehicle", []))
    lasted = content.metrics.get("duration_s", content.recorded_s)
    duration_s = content.scenario.get("duration_s")
    times = "" if lasted is None else f", {lasted:g} s simulated"
    if lasted is not None and duration_s is not None and lasted < duration_s:
        times = f", {lasted:g} of {duration_s:g} s simulated"
    real = sum("driver" in each for each in content.scenario.get("vehicle", []))
    words = counted(vehicles, "vehicle") if vehicles else "A run that was cut"
    of_them = f", {real} of them real" if real else ""
    return f"{words}{of_them}{times}."


def radio_sentences(radio: Mapping[str, Any]) -> Iterator[str]:
    """Sentences on the outcome of the frames, from the radio metrics."""
    if not radio["frames"]:
        yield "Nobody sent anything."
    elif radio["delivery_ratio"] is None:
        yield f"{radio['frames']} frames were sent, and all were still under way when the run ended."
    else:
        sentence = f"{radio['frames']} frames were sent, and {100.0 * radio['delivery_ratio']:.1f} % arrived"
        losses = sorted(radio["losses"].items(), key=lambda each: -each[1])
        causes = [f"{count} {cause}" for cause, count in losses[:3]]
        if len(losses) > 3:
            causes.append("...")
        if causes:
            sentence += f" (lost: {', '.join(causes)})"
        if under_way := radio.get("under_way"):
            sentence += f", {under_way} were still under way"
        if (age := radio["age_s"]["mean"]) is not None:
            sentence += f"; what was known of others was {age:.3g} s old on average"
        yield f"{sentence}."


def _formation(formation: Mapping[str, Any]) -> Iterator[str]:
    if formation["rms_m"] is not None:
        settled = formation["settling_s"]
        yield (
            f"Followers were {formation['rms_m']:.3g} m off their places (RMS), {formation['max_m']:.3g} m at most, "
            + ("and did not settle within 5 cm." if settled is None else f"and within 5 cm from {settled:g} s on.")
        )


def _mission(mission: Mapping[str, Any]) -> Iterator[str]:
    targets, area = len(mission["found_s"]), mission["area_seen_ratio"]
    if targets:
        yield f"{mission['targets_found']} of {targets} targets were found, and {mission['targets_tracked']} tracked."
    if area is not None:
        yield f"Of the area {100.0 * area:.0f} % were seen."


def _safety(metrics: Mapping[str, Any]) -> Iterator[str]:
    collisions, least = metrics["safety"]["collisions"], metrics["safety"]["min_clearance_m"]
    if collisions:
        yield f"Bodies touched {counted(collisions, 'time')}."
    elif least is not None:
        yield f"Nothing touched anything; the least clearance was {least:.3g} m."
    faulty = [name for name, each in metrics["agents"].items() if any(each.values())]
    if faulty:
        yield f"Agents that missed ticks: {', '.join(faulty[:5])}{' and others' if len(faulty) > 5 else ''}."
    stopped = {name: sum(each["stops"].values()) for name, each in metrics.get("hardware", {}).items()}
    for name, times in stopped.items():
        if times:
            yield f"{name}, which is real, was stopped {counted(times, 'time')}."
