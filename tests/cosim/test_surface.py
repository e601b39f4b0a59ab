"""Public names of ``import cosim``, the modules that it loads, and the layers of packages."""

import importlib
import re
import subprocess
import sys
import tomllib

import pytest

import vcmvsp
from tests.support.paths import ROOT

pytestmark = pytest.mark.processes

NAMES = {
    "runs.api": "run Result",
    "runs.stepping": "start SteppedRun",
    "studies.engine": "study",
    "agent": "Agent Observation Radio VehicleInfo",
    "types": (
        "VehicleState Velocity Waypoint Message Reception Follows Positive NonNegative Probability "
        "Odometry Fix Imu Scan Image Measured"
    ),
    "received": "ReceivedMessages",
    "frames": "arc wrap rotate2 yaw_of quaternion_from_yaw",
    "errors": "VcmvspError ScenarioError UsageError FederateError AgentError Interrupted",
}
PUBLIC = [(name, home) for home, names in NAMES.items() for name in names.split()]
HEAVY = {"numpy", "pybullet", "cv2", "zenoh", "matplotlib", "pyarrow", "mcap", "simpy"}


def test_the_public_names() -> None:
    assert sorted(vcmvsp.__all__) == sorted(name for name, _ in PUBLIC)


@pytest.mark.parametrize(("name", "home"), PUBLIC)
def test_every_public_name_is_that_of_its_module(name: str, home: str) -> None:
    module = importlib.import_module(f"vcmvsp.cosim.{home}")
    assert getattr(vcmvsp, name) is getattr(module, name)
    assert name in dir(vcmvsp)


def test_another_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="module 'vcmvsp' has no attribute 'Agnet'"):
        _ = vcmvsp.Agnet
    with pytest.raises(ImportError, match="Agnet"):
        exec("from vcmvsp import Agnet", {})


def modules_after(code: str) -> set[str]:
    """Names of top-level modules, and of parts of vcmvsp, loaded by a fresh interpreter that has run ``code``."""
    script = f"{code}\nimport sys\nprint(*sys.modules, file=sys.stderr)"
    process = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=500, check=True)
    return {name.removeprefix("vcmvsp.").partition(".")[0] for name in process.stderr.split()}


@pytest.mark.parametrize("code", ["import vcmvsp", "import vcmvsp.cosim.cli.app", "from vcmvsp import ScenarioError"])
def test_the_core_and_its_command_line_load_nothing_heavy(code: str) -> None:
    assert not modules_after(code) & HEAVY


def test_help_loads_nothing_heavy() -> None:
    code = "from vcmvsp.cosim.cli.app import main\ntry:\n    main(['run', '--help'])\nexcept SystemExit:\n    pass"
    assert not modules_after(code) & HEAVY


def test_agents_need_only_numpy() -> None:
    code = "from vcmvsp import Agent, Observation, Radio, Velocity, arc, wrap"
    assert modules_after(code) & (HEAVY | {"physics", "netsim", "agents", "hardware"}) == {"numpy"}


def test_the_shipped_agents_load_no_other_part() -> None:
    shipped = ("followers.leader_follower", "leaders.trajectory")
    code = "; ".join(f"import vcmvsp.agents.formation.{module}" for module in shipped)
    assert modules_after(code) & (HEAVY | {"physics", "netsim", "hardware"}) == {"numpy"}


def test_every_error_has_its_exit_code() -> None:
    kinds = [getattr(vcmvsp, name) for name in NAMES["errors"].split()]
    assert [kind.exit_code for kind in kinds] == [1, 2, 2, 3, 3, 130]
    assert all(issubclass(kind, vcmvsp.VcmvspError) for kind in kinds)


def test_every_package_has_its_layer() -> None:
    """A package in no layer could import everything."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]["contracts"]
    (layers,) = (each["layers"] for each in contracts if each["name"] == "Layers")
    listed = {name.strip() for layer in layers for name in re.split(r"[|:]", layer)}
    inner = {
        f"cosim.{each.stem}" for each in (ROOT / "cosim").iterdir() if each.suffix == ".py" or (each / "__init__.py").exists()
    }
    assert listed == inner - {"cosim.__init__"} | {"physics", "netsim", "agents", "hardware"}
