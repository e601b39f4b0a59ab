"""A vehicle with an agent and a program in simulated time: equal bytes in any process."""

from pathlib import Path
from typing import Any

import pytest

from tests.support.netsim.socket_programs import run_programs, scenario
from vcmvsp.cosim.sockets import Socket

pytestmark = [pytest.mark.processes, pytest.mark.sockets]

TALKER = """
from vcmvsp import Agent

class Talker(Agent):
    def act(self, obs, radio):
        radio.send(t=obs.time_ns, heard=len(obs.heard))
"""


def play(socket: Socket) -> None:
    while True:
        socket.sendto(b"p" * 200)
        socket.sleep(0.1)


@pytest.mark.parametrize("routing", [{}, {"routing": {"kind": "flooding"}}], ids=["direct", "routed"])
def test_simultaneous_messages_have_a_fixed_order_in_any_process(tmp_path: Path, routing: dict[str, Any]) -> None:
    (tmp_path / "talker.py").write_text(TALKER)
    radio = {"preset": "wifi-b-1", "loss": {"probability": 0.3}}
    content = scenario(tmp_path, "tom", "zed", radio=radio, **routing)
    content["sockets"]["vehicles"] = ["tom"]
    for vehicle in content["vehicle"]:
        vehicle["agent"] = {"kind": f"{tmp_path / 'talker.py'}:Talker"}
    here, elsewhere = (run_programs(content, {"tom": play}, mcap=False, agents=where) for where in ("inprocess", "process"))
    assert here.radio.equals(elsewhere.radio)
    assert here.metrics["digest"] == elsewhere.metrics["digest"]
