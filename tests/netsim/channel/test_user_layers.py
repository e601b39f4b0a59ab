"""User-written layers: required methods, and the error for answers of wrong type, shape or value."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import vcmvsp
from tests.support.cosim.command_line import vcmvsp_command
from tests.support.netsim.channels import make_channel, send
from vcmvsp.cosim.config.builtin_kinds import VERBS
from vcmvsp.cosim.errors import FederateError, ScenarioError
from vcmvsp.netsim.channel.channel import Channel
from vcmvsp.netsim.interfaces import layers as protocols
from vcmvsp.netsim.presets import LAYERS

pytestmark = pytest.mark.slow

LEVELS = ["3.0", "np.ones(7)", "np.ones((n, 1))", "np.full(n, np.nan)", "np.full(n, np.inf)", "np.full(n, '3')", "None"]
CHOICES = ["True", "np.ones(7, bool)", "np.zeros(n)", "np.zeros(n, int)", "np.full(n, np.nan)", "None"]
TIMES = ["5", "np.ones(7, int)", "np.zeros(n)", "np.full(n, np.inf)", "np.full(n, 2**63, 'u8')", "np.ones(n, bool)", "None"]
PATHS = ("paths", "len(paths.distance_m)")
FRAME = ("frame, draw", "len(frame.receivers)")
TRACED = ("frame", "len(frame.receivers)")
SENT = ("sender_row, rows, received_ns, size, draw", "len(rows)")
DELIVERED = ["received_ns", "(3, 4)", "(received_ns * 1.0, received_ns)", "(received_ns - 9, received_ns)", "None"]
ANSWERS = {  # of a layer's methods: arguments, where n is, a good answer, bad ones
    "path_loss.loss_db": (*PATHS, "np.ones(n)", LEVELS),
    "walls.loss_db": (*PATHS, "np.ones(n)", LEVELS),
    "shadowing.loss_db": (*PATHS, "np.ones(n, int)", LEVELS),
    "fading.gain_db": (*FRAME, "np.ones(n, np.float32)", LEVELS),
    "script.gain_db": (*FRAME, "np.ones(n)", LEVELS),
    "script.lost": (*FRAME, "np.zeros(n, bool)", CHOICES),
    "script.delay_ns": (*FRAME, "np.ones(n, int)", TIMES),
    "trace.level_dbm": (*TRACED, "np.full(n, np.nan)", [each for each in LEVELS if "nan" not in each]),
    "trace.lost": (*FRAME, "np.zeros(n, bool)", CHOICES),
    "trace.delay_ns": (*FRAME, "np.ones(n, int)", TIMES),
    "trace.traced": (*TRACED, "np.ones(n, bool)", CHOICES),
    "jammer.interference_mw": ("start_ns, end_ns, rx, loss_db, where", "len(rx)", "np.zeros(n)", [*LEVELS, "np.full(n, -1.0)"]),
    "phy.air_time_ns": ("size", "0", "np.int64(size + 1)", ["0", "1e3", "np.nan", "True", "np.ones(2, int)", "None"]),
    "mac.open": ("phy, count, keys, noise_mw", "0", "None", ["3.0", "keys"]),
    "loss.lost": (*FRAME, "np.zeros(n, bool)", CHOICES),
    "delay.delay_ns": (*FRAME, "np.ones(n, np.int32)", TIMES),
    "delivery.deliver": (*SENT, "(received_ns, np.full(n, -1))", DELIVERED),
    "delivery.open": ("count", "0", "None", []),
}
ATTRIBUTES = "cause = 'mine'\n    columns = ('rssi_dbm', 'loss', 'delay_s')\n    tx_power_dbm, sensitivity_dbm = 0.0, -300.0\n"
CASES = [(key, bad) for key, (_, _, _, bads) in ANSWERS.items() for bad in bads]


def own(folder: Path, layer: str, failing: str = "", bad: str = "None", *, calls: int = 4, attributes: str = ATTRIBUTES) -> str:
    """Registered kind of a user-written layer whose method ``failing`` returns ``bad`` after some calls."""
    text = f"import numpy as np\n\n\nclass Own:\n    {attributes}    calls = 0\n"
    for key, (arguments, count, good, _) in ANSWERS.items():
        if key.startswith(f"{layer}."):
            text += f"\n    def {key.partition('.')[2]}(self, {arguments}):\n        n = {count}\n"
            if key == failing:
                text += f"        Own.calls += 1\n        if Own.calls > {calls}:\n            return {bad}\n"
            text += f"        return {good}\n"
    (folder / "own.py").write_text(text)
    return f"{folder / 'own.py'}:Own"


def scenario(layer: str, kind: str) -> dict[str, Any]:
    """A vehicle that drives away from two others and reports its position to them ten times a second."""
    driver = {"name": "car0", "kind": "p2dx", "agent": {"kind": "trajectory", "path": "straight", "speed": 0.5}}
    others = [{"name": f"car{i}", "kind": "p2dx", "pose": [-1.0, float(i), 0.0]} for i in (1, 2)]
    return {
        "name": "own-layers",
        "duration_s": 2.0,
        "physics": {"kind": "kinematic"},
        "radio": {layer: {"kind": kind}},
        "vehicle": [driver, *others],
    }


def air(layer: str, kind: str) -> Channel:
    changes: Any = {layer: {"kind": kind}}
    return make_channel(**changes)


def send_often(channel: Channel) -> None:
    for number in range(6):
        send(channel, 10.0 + number, 20.0, sent_ns=number * 10**8)


@pytest.mark.parametrize("layer", LAYERS)
def test_a_layer_with_its_verbs_is_enough(layer: str, tmp_path: Path) -> None:
    send_often(air(layer, own(tmp_path, layer)))


@pytest.mark.parametrize(("verb", "bad"), [*CASES, *((verb, "[][0]") for verb in ANSWERS)])
def test_a_wrong_answer_or_an_exception_is_one_error_that_names_layer_and_class(verb: str, bad: str, tmp_path: Path) -> None:
    layer, _, method = verb.partition(".")
    kind = own(tmp_path, layer, verb, bad, calls=0 if layer == "mac" or bad == "[][0]" else 4)
    with pytest.raises((FederateError, ScenarioError)) as caught:  # the latter where the channel asks during assembly
        send_often(air(layer, kind))
    problem = f"{method} must return "
    if bad == "[][0]":
        line = next(k for k, text in enumerate((tmp_path / "own.py").read_text().splitlines(), 1) if bad in text)
        problem = f"IndexError: list index out of range (own.py line {line}, in {method})"
    assert f"{layer} Own (own.py line 4): {problem}" in str(caught.value)


@pytest.mark.parametrize("verb", ["path_loss.loss_db", "fading.gain_db", "loss.lost", "delay.delay_ns", "phy.air_time_ns"])
def test_the_recording_before_a_wrong_answer_is_complete(verb: str, tmp_path: Path) -> None:
    layer, bad = verb.partition(".")[0], ANSWERS[verb][3][0]
    with pytest.raises(FederateError, match=rf"radio: {layer} Own \(own.py line 4\)") as caught:
        vcmvsp.run(scenario(layer, own(tmp_path, layer, verb, bad)), out=tmp_path / "out")
    assert caught.value.exit_code == 3
    assert pq.read_table(tmp_path / "out" / "radio.parquet").num_rows == 2 * 4  # four frames, each to two vehicles
    assert (tmp_path / "out" / "run.mcap").stat().st_size
    result = vcmvsp_command("radio", str(tmp_path / "out"))
    assert (result.code, result.err) == (0, "")


@pytest.mark.parametrize("layer", ["loss", "script", "trace", "delivery"])
@pytest.mark.parametrize("cause", ["", "cause = 'received'", "cause = 'under way'", "cause = ''", "cause = 3", "cause = None"])
def test_a_loss_layer_needs_a_cause_of_its_own(layer: str, cause: str, tmp_path: Path) -> None:
    rest = "columns = ('loss',)\n"
    kind = own(tmp_path, layer, attributes=f"{cause or 'pass'}\n    {rest}")
    with pytest.raises(ScenarioError, match=rf"radio\.{layer}: {layer} Own \(own.py line 4\): (has no )?cause") as caught:
        air(layer, kind)
    assert caught.value.exit_code == 2


@pytest.mark.parametrize("name", ["tx_power_dbm", "sensitivity_dbm", "noise_dbm", "preamble_snr_db", "errors"])
@pytest.mark.parametrize("value", ["'3'", "float('nan')", "property(lambda self: [][0])"])
def test_properties_of_a_phy_are_checked(name: str, value: str, tmp_path: Path) -> None:
    kind = own(tmp_path, "phy", attributes=f"{ATTRIBUTES}    {name} = {value}\n")
    with pytest.raises(ScenarioError, match=rf"radio\.phy: phy Own \(own.py line 4\): {name}"):
        air("phy", kind)


@pytest.mark.parametrize("layer", ["script", "trace", "jammer", "delivery"])
def test_a_class_without_one_of_its_verbs_is_refused(layer: str, tmp_path: Path) -> None:
    kind = own(tmp_path, layer)
    for verb in re.findall(r"(\w+)\(", VERBS[layer]):
        text = (tmp_path / "own.py").read_text()
        (tmp_path / "own.py").write_text(text.replace(f"def {verb}(", "def other("))
        with pytest.raises(ScenarioError, match=rf"is not a {layer}: it lacks {verb}\("):
            air(layer, kind)
        (tmp_path / "own.py").write_text(text)


def test_a_medium_of_a_users_own_is_named_too(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "class Air:\n"
        "    def expect(self, frames): pass\n"
        "    def offer(self, frame): pass\n"
        "    def advance(self, until_ns): return [3]\n"
        "    def next_ns(self): return 1 / 0\n\n"
        "class Own:\n"
        "    def open(self, phy, count, keys, noise_mw): return Air()\n"
    )
    channel = air("mac", f"{tmp_path / 'own.py'}:Own")
    message = vcmvsp.Message(sender="car0", body={}, size_bytes=9)
    channel.send(0, message, ("car0", "car1"), np.zeros((2, 3)))
    with pytest.raises(FederateError, match=r"mac Air \(own.py line 1\): ZeroDivisionError: .* \(own.py line 5, in next_ns\)"):
        channel.next_ns()
    with pytest.raises(FederateError, match=r"mac Air \(own.py line 1\): advance must return a list of Decided, not \[3\]"):
        channel.advance(1)


def test_answers_by_draws_are_checked(tmp_path: Path) -> None:
    text = "class Own:\n    cause = 'mine'\n    lost = None\n    def lost(self, frame, draw): pass\n"
    (tmp_path / "own.py").write_text(text + "    def lost_by(self, draws): return draws[..., 0]\n")
    with pytest.raises(FederateError, match=r"loss Own \(own.py line 1\): lost_by must return an array of booleans"):
        send_often(air("loss", f"{tmp_path / 'own.py'}:Own"))


@pytest.mark.parametrize("layer", LAYERS)
def test_commands_have_no_traceback_for_own_layers(layer: str, tmp_path: Path) -> None:
    kind = own(tmp_path, layer, f"{layer}.loss_db", "3.0", calls=0, attributes="pass\n")
    (tmp_path / "s.toml").write_text(
        f"name = 's'\nduration_s = 1.0\n[physics]\nkind = 'kinematic'\n[radio.{layer}]\nkind = '{kind}'\n"
        "[[vehicle]]\nname = 'car1'\nkind = 'p2dx'\n"
    )
    for command in (
        ["check", str(tmp_path / "s.toml")],
        ["pathloss", "--preset", "ideal", "--distance", "1:9:4", "--set", f"{layer}.kind={kind}"],
    ):
        result = vcmvsp_command(*command)
        assert result.code in (0, 2, 3)
        assert result.err.count("\n") <= 1, result.err
        assert "Own" in result.err or result.code == 0


@pytest.mark.parametrize("layer", LAYERS)
def test_every_verb_is_in_the_table_of_layers(layer: str) -> None:
    table = re.sub(r"\s+", " ", protocols.__doc__ or "")
    for verb in re.findall(r"(\w+)\(", VERBS[layer]):
        assert layer in table
        assert f"{verb}(" in table
    assert {key.partition(".")[2] for key in ANSWERS if key.startswith(f"{layer}.")} == set(
        re.findall(r"(\w+)\(", VERBS[layer])
    )
