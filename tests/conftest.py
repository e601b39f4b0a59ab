"""Settings and fixtures of all tests."""

import asyncio
import contextlib
import gc
import inspect
import os
import signal
from collections.abc import Iterator
from importlib.util import find_spec

import pytest
from hypothesis import settings

# Compilation takes longer than it saves in most tests: only comparisons of both ways and one long flight use it.
os.environ.setdefault("VCMVSP_COMPILED", "0")
os.environ["VCMVSP_FIGURES"] = "0"  # drawing takes ten times as long as most runs
# Durations depend on the load of the machine; each session draws new examples.
settings.register_profile("here", deadline=None, max_examples=50)
settings.load_profile("here")

gc.disable()  # until all tests are collected: a third of that time

if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:  # in the background of a script; programs of tests would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

pytest_plugins = ["tests.support.requirements"]
collect_ignore_glob = []
if find_spec("pybullet") is None:  # Python 3.14: these tests need Bullet
    collect_ignore_glob = ["physics/dynamics/bullet/*", "physics/dynamics/test_rigid_body.py", "physics/raycast/test_caster.py"]
    collect_ignore_glob += ["physics/vehicles/test_urdf.py", "cosim/cli/test_bench.py"]


def pytest_collection_finish() -> None:
    """Objects of the collection live until the end: exclude them from garbage collection (a tenth of the total time)."""
    gc.enable()
    gc.collect()
    gc.freeze()


@pytest.fixture
def stack() -> Iterator[contextlib.ExitStack]:
    """Closes its contexts when the test ends."""
    with contextlib.ExitStack() as closing:
        yield closing


@pytest.fixture(scope="module")
def figures() -> Iterator[None]:
    """Draws figures, in test files that check them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VCMVSP_FIGURES", "1")
        yield


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine in its own event loop."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    names = inspect.signature(pyfuncitem.obj).parameters
    asyncio.run(pyfuncitem.obj(**{name: pyfuncitem.funcargs[name] for name in names}))
    return True
