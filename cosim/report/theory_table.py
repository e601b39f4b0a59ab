"""What theory expects of a run, beside what came out. A row stands only where the scenario fulfils what its law asks for.

The half-widths are of 95 % of all runs that differ in their draws alone; where a law leaves nothing to chance there is none.
"""

from collections.abc import Iterator

from vcmvsp.cosim.metrics.motion import motion
from vcmvsp.cosim.report import motion_laws, radio_laws
from vcmvsp.cosim.report.law import Expected, MeasuredRun
from vcmvsp.cosim.report.page import Part, Rows, Words, cell
from vcmvsp.cosim.report.run_folder import Left


def expectation_table(left: Left) -> list[Part]:
    """What was expected and what was measured; nothing where no law applies."""
    rows = list(_expected(left))
    if not rows:
        return []
    head = ["quantity", "unit", "expected", "95 % of runs", "measured", "law", "it holds because"]
    return [
        Words("Closed forms, where this scenario is as they assume. Chance alone puts one number in twenty outside its range."),
        Rows(head, [_row(each) for each in rows]),
    ]


def _expected(left: Left) -> Iterator[Expected]:
    recording = left.recording
    if recording is None or left.links is None or not left.scenario or not left.metrics:
        return
    if left.scenario.get("intervention"):  # the operator had a hand in it
        return
    run = MeasuredRun(left.scenario, left.metrics, recording, left.links, motion(recording.states))
    try:
        yield from radio_laws.laws(run)
        yield from motion_laws.laws(run)
    except KeyError:  # a scenario of another version lacks a key that a law needs
        return


def _row(each: Expected) -> list[object]:
    low_high = None
    if each.spread is not None:
        low_high = f"{cell(each.expected - each.spread)} to {cell(each.expected + each.spread)}"
    return [each.quantity, each.unit, each.expected, low_high, each.measured, each.law, each.holds]
