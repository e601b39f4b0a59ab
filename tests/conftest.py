"""What holds for all tests."""

import asyncio
import contextlib
import gc
import inspect
import os
from collections.abc import Iterator
from importlib.util import find_spec

import pytest
from hypothesis import settings

# Compilation takes longer than most tests save by it: only those that compare both ways do so, and one that flies for long.
os.environ.setdefault("VCMVSP_COMPILED", "0")
os.environ["VCMVSP_FIGURES"] = "0"  # drawing takes ten times as long as the run of most tests
settings.register_profile("here", deadline=None)  # how long an example takes depends on what else the machine does
settings.load_profile("here")

pytest_plugins = ["tests.support.requirements"]
collect_ignore_glob = []
if find_spec("pybullet") is None:  # Python 3.14: what these files say of Bullet cannot be asked
    collect_ignore_glob = ["physics/dynamics/bullet/*", "physics/dynamics/test_rigid_body.py", "physics/raycast/test_caster.py"]
    collect_ignore_glob += ["physics/vehicles/test_urdf.py", "cosim/cli/test_bench.py"]


def pytest_collection_finish() -> None:
    """What collection has left lives until the end: no garbage collection visits it again (a tenth of all time)."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    """Closes what is entered into it when the test ends."""
    with contextlib.ExitStack() as closing:
        yield closing


@pytest.fixture(scope="module")
def figures() -> Iterator[None]:
    """For test files that look at the figures of runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VCMVSP_FIGURES", "1")
        yield


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine on a loop of its own."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    asyncio.run(pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names}))
    return True
