"""The timed scenarios, and one run of them without set-up and files."""

import io
from typing import Any, Literal

from bench.measure import cpu
from vcmvsp.cosim.assembly.run import assemble
from vcmvsp.cosim.kernel.kernel import Kernel
from vcmvsp.cosim.scenario import loader as scenarios

Recording = Literal["mcap", "tables", "nothing"]
"""What a run keeps in memory: all, with the file that Foxglove opens; tables and metrics, as in a study; or nothing."""


def star(vehicles: int, *, physics: str, duration_s: float) -> dict[str, Any]:
    """A leader on a circle that broadcasts at 10 Hz over a lossy 802.11b, and followers in two files behind it."""
    kind = "kinematic" if physics == "kinematic" else "p2dx"
    listed: list[dict[str, Any]] = [{"name": "car0", "agent": {"kind": "trajectory"}}]
    for number in range(1, vehicles):
        row, side = (number + 1) // 2, 1 if number % 2 else -1
        follower = {"kind": "leader_follower", "leader": "car0", "distance": 1.0 * row, "bearing_deg": -30.0 * side}
        listed.append({"name": f"car{number}", "pose": [-0.866 * row, 0.5 * side * row, 0.0], "agent": follower})
    return {
        "name": "star",
        "duration_s": duration_s,
        "physics": {"kind": physics},
        "radio": {"preset": "wifi-b-1", "loss": {"probability": 0.2}, "delay": {"seconds": 0.05, "jitter_s": 0.02}},
        "vehicles": {"kind": kind},
        "agents": {"period_s": 0.1},
        "vehicle": listed,
    }


def run_cpu_s(scenario: dict[str, Any], recording: Recording = "mcap") -> float:
    """CPU seconds of one run in this process: kernel, radio, agents, physics and recording; neither set-up nor files."""
    parsed, source = scenarios.load(scenario)
    with assemble(parsed, source) as assembled:
        kernel = Kernel(assembled.info, assembled.federates)
        kernel.start()
        recorder = assembled.recorder(io.BytesIO() if recording == "mcap" else None)

        def work() -> None:
            kernel.run((lambda _: None) if recording == "nothing" else recorder.on)
            recorder.close(kernel.now_ns)
            if recording == "tables":
                recorder.metrics(window=(0.0, None))

        seconds = cpu(work)
        kernel.close()
    return seconds
