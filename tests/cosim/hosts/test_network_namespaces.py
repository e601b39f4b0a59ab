"""Hosts on machines of their own, behind a slow network that breaks: the files of one process; intruders get nothing."""

import contextlib
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import vcmvsp
from tests.support.cosim.command_line import contents
from tests.support.cosim.network_namespaces import MIDDLE, PORT, RUN, Network
from tests.support.cosim.run_processes import Stage, ended, wait_for
from vcmvsp.cosim.security import authority

SCENARIO = """
name = "far"
duration_s = {duration}
[physics]
kind = "kinematic"
[radio]
preset = "ideal"
loss = {{ probability = 0.3 }}
[agents]
runs = "zenoh"
deadline_s = 20.0
join_timeout_s = 60.0
[vehicles]
kind = "kinematic"
[[vehicle]]
name = "car1"
agent = {{ kind = "trajectory" }}
[[vehicle]]
name = "car2"
pose = [-1.0, 0.0, 0.0]
agent = {{ kind = "leader_follower", leader = "car1" }}
[[vehicle]]
name = "car3"
pose = [-1.0, 0.5, 0.0]
agent = {{ kind = "leader_follower", leader = "car1" }}
"""


class Far(Stage):
    """A run with keys on a machine of its own, and hosts on others."""

    def __init__(self, folder: Path, network: Network, duration: float) -> None:
        super().__init__(folder)
        self.network = network
        (folder / "far.toml").write_text(SCENARIO.format(duration=duration))
        authority.init(folder / "keys")
        authority.renew_hub(folder / "keys", [MIDDLE])

    def keys(self, name: str, *vehicles: str, of: str = "keys") -> str:
        bundle = authority.issue(self.folder / of, name, list(vehicles))
        return str(bundle.path)

    def run(self, *more: str) -> "subprocess.Popen[str]":
        listen = ["--listen", f"tls/{RUN}:{PORT}", "--keys", "keys"]
        return self.start("run", "far.toml", *listen, "--out", "out", *more, before=self.network.inside("run"))

    def host(self, number: int, keys: str, *vehicles: str) -> "subprocess.Popen[str]":
        whose = [word for vehicle in vehicles for word in ("--vehicle", vehicle)]
        connect = ["--connect", self.network.endpoint(number), "--keys", keys]
        return self.start("agent", *whose, *connect, before=self.network.inside(f"far{number}"))

    def reference(self) -> dict[str, bytes]:
        """The files of the same run in this process."""
        vcmvsp.run(self.folder / "far.toml", agents="inprocess", out=self.folder / "reference")
        return contents(self.folder / "reference")


@contextlib.contextmanager
def busy() -> Iterator[None]:
    """Somebody else wants all cores."""
    burners = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def test_three_far_hosts_one_of_them_late_on_busy_machines_give_the_files_of_one_process(tmp_path: Path) -> None:
    with Network([0, 20, 50]) as network, Far(tmp_path, network, 2.0) as far, busy():
        names = {f"car{number + 1}": far.keys(f"machine{number}", f"car{number + 1}") for number in range(3)}
        run = far.run()
        hosts = [far.host(number, keys, vehicle) for number, (vehicle, keys) in enumerate(names.items()) if number < 2]
        time.sleep(3.0)
        hosts.append(far.host(2, names["car3"], "car3"))
        code, said = ended(run)
        assert code == 0, said
        assert [ended(host)[0] for host in hosts] == [0, 0, 0]
        assert contents(far.out) == far.reference()


def test_one_far_host_that_is_cut_off_for_three_seconds_gives_the_files_of_one_process(tmp_path: Path) -> None:
    with Network([10]) as network, Far(tmp_path, network, 4.0) as far:
        run = far.run("--realtime")
        host = far.host(0, far.keys("machine", "car1", "car2", "car3"), "car1", "car2", "car3")
        wait_for(far.out / "run.mcap")
        time.sleep(0.5)
        cutting = threading.Thread(target=network.cut, args=(0, 3.0))
        cutting.start()
        code, said = ended(run)
        cutting.join()
        assert code == 0, said
        assert ended(host)[0] == 0
        assert contents(far.out) == far.reference()
        assert json.loads((far.out / "about.json").read_text())["lateness"]["max_s"] > 1.5  # the cut was felt


LIAR = """
import sys; from pathlib import Path
from vcmvsp.agents import host_process as serve; from vcmvsp.cosim.security import certificates
certificates.Bundle.speaks_for = lambda *_: None
serve.host(sys.argv[1], ("car3",), keys=Path(sys.argv[2]))
"""
SPY = """
import sys, time, zenoh, json; from pathlib import Path; from zenoh.handlers import Callback
from vcmvsp.cosim.security import certificates; from vcmvsp.cosim.transport import key_names, access_control as security
from vcmvsp.cosim.transport.zenoh_session import COMMON
heard = Path(sys.argv[3])
bundle = certificates.load_bundle(Path(sys.argv[2]))
own = {"mode": "client", "listen": {"endpoints": []}, "connect": {"endpoints": [sys.argv[1]], "timeout_ms": 60000}}
config = security.merge(COMMON, own, security.machine_security(bundle))
listens, asks = (zenoh.open(zenoh.Config.from_json5(json.dumps(config))) for _ in range(2))
def note(what):
    with heard.open("a") as file:
        file.write(f"{what.key_expr}\\n")
each = Callback(note, indirect=False)
for key in ("**", "vcmvsp/**", "vcmvsp/topic/**", "vcmvsp/host/**", "vcmvsp/host/machine1/**", "vcmvsp/join/*"):
    listens.declare_subscriber(key, each)
    listens.declare_queryable(key, each)
for key in ("vcmvsp/host/**", key_names.HUB_ALIVE):
    listens.liveliness().declare_subscriber(key, each, history=True)
heard.touch()
while True:
    for key in ("vcmvsp/host/machine1/*/ask", "vcmvsp/join/machine1", "vcmvsp/topic/**", "@/**"):
        for reply in asks.get(key, timeout=0.5):
            if reply.ok and str(asks.zid()) not in str(reply.ok.key_expr):  # what it knows of itself
                note(reply.ok)
    asks.put("vcmvsp/topic/car3/command", b"x")
    time.sleep(0.1)
"""


def test_intruders_from_other_machines_are_refused_and_hear_nothing(tmp_path: Path) -> None:
    with Network([0, 0]) as network, Far(tmp_path, network, 2.0) as far:
        authority.init(tmp_path / "foreign")
        stranger = far.keys("machine0", "car1", of="foreign")
        mine, theirs = far.keys("machine0", "car1", "car2"), far.keys("machine1", "car3")
        run = far.run("--realtime")
        there = network.inside("far0")
        spy = far.python("-c", SPY, network.endpoint(0), mine, str(tmp_path / "heard"), before=there)
        code, said = ended(far.host(0, stranger, "car1"))
        assert code == 2
        assert f"is of another authority than {stranger}" in said
        code, said = ended(far.host(0, mine, "car3"))
        assert code == 2
        assert "is for car1, car2, not for car3" in said
        liar = far.python("-c", LIAR, network.endpoint(0), mine, before=there)
        _, said = liar.communicate(timeout=500)
        refusal = "the certificate of 'machine0' is for car1, car2, not for car3"
        assert f"the run refuses this host: {refusal}" in said
        wait_for(tmp_path / "heard")
        hosts = [far.host(0, mine, "car1", "car2"), far.host(1, theirs, "car3")]
        code, said = ended(run)
        assert code == 0, said
        assert f"refused a host with the certificate of machine0: {refusal}" in said
        assert [ended(host)[0] for host in hosts] == [0, 0]
        last = time.monotonic() + 20.0  # that the run is there, and leaves: the spy may be slow to note it
        while len(heard := (tmp_path / "heard").read_text().split()) < 2 and time.monotonic() < last:
            time.sleep(0.05)
        assert spy.poll() is None
        assert len(heard) > 1  # and comes and leaves once more, where a machine was held up for so long that a link broke
        assert set(heard) == {"vcmvsp/hub/alive"}
        assert contents(far.out) == far.reference()


FORGER = """
import sys; from pathlib import Path; from vcmvsp.agents import federate, host_process as serve
from vcmvsp.cosim.federate import Event, Step; from vcmvsp.cosim.types import Velocity
honest = federate.AgentHost.step
def step(self, now_ns, inbox):
    step = honest(self, now_ns, inbox)
    more = [Event("car3/command", now_ns, Velocity())] if now_ns >= 500_000_000 else []
    return Step([*step.events, *more], step.next_ns)
federate.AgentHost.step = step
sys.stderr.write(serve.host(sys.argv[1], ("car1", "car2"), keys=Path(sys.argv[2])))
"""


def test_a_host_that_commands_anothers_vehicle_ends_the_run_by_name(tmp_path: Path) -> None:
    with Network([0, 0]) as network, Far(tmp_path, network, 2.0) as far:
        mine, theirs = far.keys("machine0", "car1", "car2"), far.keys("machine1", "car3")
        run = far.run("--set", "agents.deadline_s=5.0")
        forger = far.python("-c", FORGER, network.endpoint(0), mine, before=network.inside("far0"))
        host = far.host(1, theirs, "car3")
        code, said = ended(run)
        assert code == 3
        assert "of vehicles car1, car2: gave an answer that is refused: it speaks for car3" in said
        assert ended(host)[0] in (0, 3)
        assert "it does not accept what this host answers: it speaks for car3" in ended(forger)[1]
        about = json.loads((far.out / "about.json").read_text())
        assert "it speaks for car3" in about["error"]["message"]
        assert about["simulated_s"] == 0.5
