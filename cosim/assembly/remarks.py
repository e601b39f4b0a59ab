"""Remarks on a scenario that is valid but hardly meant so: values without effect, in another unit, or in step with each other.

They are lines for the user; nothing is changed. A scenario that means what it says may be remarked on, too.
"""

from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

from vcmvsp.cosim.agent import AgentInfo
from vcmvsp.cosim.clock import SECOND_NS, seconds_to_ns
from vcmvsp.cosim.scenario.schema import Scenario

LONG_DELAY_S = 10.0  # longer than networks of vehicles have, and like one in ms


def remarks(
    scenario: Scenario,
    radio: Mapping[str, Any] | Sequence[Mapping[str, Any]],
    models: Mapping[str, Any],
    agents: Sequence[AgentInfo],
) -> Iterator[str]:
    """Lines on the keys of a scenario, each beginning with the key.

    Args:
        radio: its complete ``[radio]``; there are no remarks on several.
        models: of its vehicles, by name.
        agents: descriptions of its agents.
    """
    radio = radio if isinstance(radio, Mapping) else {}
    end_s, from_s = scenario.duration_s, scenario.metrics.from_s
    if from_s > end_s:
        yield f"metrics.from_s = {from_s:g}: the run ends at {end_s:g} s, so no formation error and no age is measured"
    for name, value in radio.get("delay", {}).items():
        is_time = name == "seconds" or name.endswith("_s")
        if is_time and isinstance(value, float) and value > min(LONG_DELAY_S, end_s):
            yield f"radio.delay.{name} = {value:g}: this is in seconds, and the run lasts {end_s:g} s"
    for info in agents:
        speed, most = info.params.get("speed"), getattr(models[info.vehicle], "max_speed", None)
        if isinstance(speed, float) and most is not None and speed > most:
            yield f"speed = {speed:g} m/s of the agent of {info.vehicle}: the vehicle reaches {most:g} m/s"
    periods = sorted({info.ticks.period for info in agents})
    for number, source in enumerate(radio.get("jammer", {}).get("sources", ())):
        if source.get("period_s") is not None and source["duty"] < 1.0:
            yield from _in_step(f"radio.jammer.sources[{number}].period_s", source["period_s"], source["duty"], periods)


def _in_step(key: str, period_s: float, duty: float, ticks: Sequence[Fraction]) -> Iterator[str]:
    """A remark on pulses in step with ticks (periods, ns) of agents: they always hit the same part of the frames, or none."""
    pulse = Fraction(seconds_to_ns(period_s))
    for tick in ticks:
        if tick % pulse == 0 or (pulse % tick == 0 and duty * pulse < tick):
            together = f"agents act every {float(tick / SECOND_NS):g} s, in step with the pulses"
            yield f"{key} = {period_s:g}: {together}, which hit always the same part of their frames, or none"
