"""A run in one paragraph: what was run, and what came out."""

from collections.abc import Iterator, Mapping
from typing import Any

from vcmvsp.cosim.report.run_folder import Left


def title_of(left: Left) -> str:
    """The scenario and the seed, as far as they are known."""
    found = left.metrics or left.scenario or left.head
    name = found.get("scenario") or found.get("name") or "A run"
    seed = found.get("seed")
    return str(name) if seed is None else f"{name}, seed {seed}"


def lead_of(left: Left) -> str:
    """A few sentences."""
    return " ".join(_sentences(left))


def _sentences(left: Left) -> Iterator[str]:
    yield _what(left)
    if error := left.about.get("error"):
        yield f"It ended before its time: {error['message'].rstrip('.')}."
    if not left.metrics:
        yield "It has left no numbers."
        return
    metrics = left.metrics
    yield from _radio(metrics["radio"])
    yield from _formation(metrics["formation"])
    if mission := metrics.get("mission"):
        yield from _mission(mission)
    yield from _safety(metrics)


def _what(left: Left) -> str:
    names = left.recording.facts.vehicles if left.recording else left.head.get("vehicles", "").split()
    vehicles = len(names or left.scenario.get("vehicle", []))
    lasted = left.metrics.get("duration_s", left.recorded_s)
    wanted = left.scenario.get("duration_s")
    times = "" if lasted is None else f", {lasted:g} s simulated"
    if lasted is not None and wanted is not None and lasted < wanted:
        times = f", {lasted:g} of {wanted:g} s simulated"
    real = sum("driver" in each for each in left.scenario.get("vehicle", []))
    words = f"{vehicles} vehicle{'' if vehicles == 1 else 's'}" + (f", {real} of them real" if real else "")
    return f"{words}{times}." if vehicles else f"A run that was cut{times}."


def _radio(radio: Mapping[str, Any]) -> Iterator[str]:
    if not radio["frames"]:
        yield "Nobody sent anything."
    elif radio["delivery_ratio"] is None:
        yield f"{radio['frames']} frames were sent, and all were still under way when the run ended."
    else:
        lost = ", ".join(f"{count} {cause}" for cause, count in sorted(radio["losses"].items(), key=lambda each: -each[1])[:3])
        age = radio["age_s"]["mean"]
        yield (
            f"{radio['frames']} frames were sent, and {100.0 * radio['delivery_ratio']:.1f} % arrived"
            + (f" (lost: {lost}{', ...' if len(radio['losses']) > 3 else ''})" if lost else "")
            + (f", {under_way} were still under way" if (under_way := radio.get("under_way")) else "")
            + (f"; what was known of others was {age:.3g} s old on average." if age is not None else ".")
        )


def _formation(formation: Mapping[str, Any]) -> Iterator[str]:
    if formation["rms_m"] is not None:
        settled = formation["settling_s"]
        yield (
            f"Followers were {formation['rms_m']:.3g} m off their places (RMS), {formation['max_m']:.3g} m at most, "
            + ("and did not settle within 5 cm." if settled is None else f"and within 5 cm from {settled:g} s on.")
        )


def _mission(mission: Mapping[str, Any]) -> Iterator[str]:
    targets, seen = len(mission["found_s"]), mission["area_seen_ratio"]
    if targets:
        yield f"{mission['targets_found']} of {targets} targets were found, and {mission['targets_tracked']} tracked."
    if seen is not None:
        yield f"Of the area {100.0 * seen:.0f} % were seen."


def _safety(metrics: Mapping[str, Any]) -> Iterator[str]:
    collisions, least = metrics["safety"]["collisions"], metrics["safety"]["min_clearance_m"]
    if collisions:
        yield f"Bodies touched {collisions} time{'' if collisions == 1 else 's'}."
    elif least is not None:
        yield f"Nothing touched anything; the least clearance was {least:.3g} m."
    faulty = [name for name, each in metrics["agents"].items() if any(each.values())]
    if faulty:
        yield f"Agents that missed ticks: {', '.join(faulty[:5])}{' and others' if len(faulty) > 5 else ''}."
    stopped = {name: sum(each["stops"].values()) for name, each in metrics.get("hardware", {}).items()}
    for name, times in stopped.items():
        if times:
            yield f"{name}, which is real, was stopped {times} time{'' if times == 1 else 's'}."
