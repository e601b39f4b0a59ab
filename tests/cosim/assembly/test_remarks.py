"""Remarks: valid but probably unintended values are reported at the check and at the start of a run; nothing else is."""

from pathlib import Path
from typing import Any

import pytest

from tests.support.cosim.command_line import assert_refused, vcmvsp_command
from vcmvsp.cosim.runs import api
from vcmvsp.cosim.scenario import loader


def told(name: str, **changes: Any) -> list[str]:
    """The remarks at the check of a scenario."""
    lines: list[str] = []
    api.check(name, set={key.replace("__", "."): value for key, value in changes.items()}, tell=lines.append)
    return lines


def pulsed(period_s: float, duty: float) -> dict[str, Any]:
    source = {"power_dbm": 0.0, "position": [0.0, 5.0, 0.0], "duty": duty, "period_s": period_s}
    return {"radio__jammer": {"sources": [source]}}


@pytest.mark.parametrize("name", loader.names())
def test_no_built_in_scenario_is_remarked_on(name: str) -> None:
    assert told(name) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"duration_s": 10.0}, "metrics.from_s = 20: the run ends at 10 s, so no formation error"),
        ({"vehicle__car1__agent__speed": 300.0}, "speed = 300 m/s of the agent of car1: the vehicle reaches 1.6 m/s"),
        ({"radio__delay__seconds": 100.0}, "radio.delay.seconds = 100: this is in seconds, and the run lasts 60 s"),
        (pulsed(0.1, 0.2), "period_s = 0.1: agents act every 0.1 s, in step with the pulses"),
        (pulsed(0.05, 0.2), "period_s = 0.05: agents act every 0.1 s, in step with the pulses"),
        (pulsed(0.4, 0.2), "period_s = 0.4: agents act every 0.1 s, in step with the pulses"),
    ],
)
def test_unlikely_values_are_remarked_on_with_their_key(changes: dict[str, Any], words: str) -> None:
    (line,) = told("formation-circle", **changes)
    assert words in line


@pytest.mark.parametrize("changes", [pulsed(0.103, 0.2), pulsed(0.4, 0.5), pulsed(0.1, 1.0), {"radio__delay__seconds": 5.0}])
def test_plausible_values_are_not_remarked_on(changes: dict[str, Any]) -> None:
    """Pulses of 0.4 s with a duty of 0.5 hit two ticks of four; a jammer with a duty of 1 does not pulse."""
    assert told("formation-circle", **changes) == []


@pytest.mark.usefixtures("here")
def test_a_missing_error_is_explained_before_and_after() -> None:
    outcome = vcmvsp_command("run", "formation-circle", "--set", "duration_s=1", "--agents", "inprocess")
    assert "metrics.from_s = 20: the run ends at 1 s" in outcome.err
    assert "formation: no error: metrics.from_s = 20 s, the run ended at 1 s" in outcome.out


@pytest.mark.parametrize(
    ("key", "value", "proposal"),
    [("delay", 0.3, "seconds = 0.3"), ("loss", 0.3, "probability = 0.3"), ("path_loss", 3.0, "exponent = 3.0")],
)
def test_a_number_in_place_of_a_layers_table_proposes_the_key_that_it_fits(key: str, value: float, proposal: str) -> None:
    outcome = vcmvsp_command("check", "formation-circle", "--set", f"radio.{key}={value}")
    assert_refused(outcome, f"radio.{key}: must be a table, not {value}; did you mean radio.{key}.{proposal}?")


def test_a_scenario_is_found_without_its_ending_and_a_module_that_is_a_file_is_proposed(here: Path) -> None:
    (here / "law.py").write_text("from vcmvsp import Agent, Velocity\nclass Law(Agent):\n    def act(self, obs, radio):\n")
    (here / "gap.toml").write_text(
        'name = "gap"\nduration_s = 1.0\n[[vehicle]]\nname = "a"\nkind = "point"\nagent = { kind = "law:Law" }\n'
    )
    assert_refused(vcmvsp_command("check", "gap"), "gap.toml line 6", "did you mean 'law.py:Law'?")
