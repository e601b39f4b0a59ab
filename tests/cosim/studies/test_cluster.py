"""Studies on a cluster: two Dask workers on this machine."""

import concurrent.futures
import importlib
import math
import re
import socket
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w

from tests.support.cosim.command_line import vcmvsp_command
from tests.support.cosim.studies import ESTIMATOR, LOSS, mine, two
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.studies import worker as clusters
from vcmvsp.cosim.studies.engine import study
from vcmvsp.cosim.studies.worker import Work, WorkersGoneError

VARY: dict[str, list[Any]] = {LOSS: [0.0, 0.4], ESTIMATOR: ["hold", "dr"]}
pytestmark = [
    pytest.mark.processes,
    pytest.mark.sockets,
    pytest.mark.filterwarnings("ignore"),  # warnings of the library
]


@pytest.fixture(scope="module")
def dask() -> Iterator[Any]:
    import dask as library
    import distributed

    library.config.set({"distributed.scheduler.allowed-failures": 0})  # one death is enough: each costs a new worker
    with distributed.LocalCluster(n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None) as cluster:  # type: ignore[no-untyped-call]
        yield cluster


def test_rows_equal_this_machines_byte_for_byte(dask: Any, tmp_path: Path) -> None:
    for where, chosen in (("here", {"jobs": 2}), ("there", {"cluster": dask.scheduler_address})):
        study(two(), vary=VARY, seeds=5, out=tmp_path / where, **chosen)
    here, there = ((tmp_path / where / "study.parquet").read_bytes() for where in ("here", "there"))
    assert here == there


def test_failures_are_rows_and_files_are_found(dask: Any, tmp_path: Path) -> None:
    settings = {"vehicle.car1.agent.bad_seed": 1}
    here, there = (
        study(mine(tmp_path), vary={"agents.nap_s": [0.0, 0.001]}, seeds=2, set=settings, **chosen)
        for chosen in ({"jobs": 1}, {"cluster": dask})
    )
    assert here.equals(there)
    assert here["error"].null_count == 2


def test_another_version_is_named(dask: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from vcmvsp.cosim.studies import engine

    monkeypatch.setattr(engine, "version", lambda: "0.0.0")
    with pytest.raises(UsageError, match=r"tcp://.* has vcmvsp .*, this is 0.0.0"):
        study(two(), vary=VARY, seeds=1, cluster=dask.scheduler_address)


def test_a_run_that_kills_its_workers_is_a_row(dask: Any, tmp_path: Path) -> None:
    text = mine(tmp_path).read_text()
    (tmp_path / "mine.toml").write_text(text.replace("mine.py:Mine", "deadly.py:Deadly"))
    (tmp_path / "deadly.py").write_text(
        "import os\nfrom mine import Mine\nclass Deadly(Mine):\n    def act(self, obs, radio):\n"
        "        os._exit(1) if self.seed == 0 and obs.time_ns else None\n        return super().act(obs, radio)\n"
    )
    found = study(tmp_path / "mine.toml", vary={"agents.nap_s": [0.0]}, seeds=2, cluster=dask.scheduler_address)
    assert found["error"].to_pylist() == ["its worker died", None]


class Future:
    """A future of Dask's that passes through ``states``."""

    def __init__(self, key: str, *states: str) -> None:
        self.key, self._states = key, list(states)

    @property
    def status(self) -> str:
        return self._states[0]

    def next_state(self) -> None:
        self._states = self._states[1:] or self._states

    def exception(self) -> None:
        return None

    def result(self) -> bytes:
        if self.status == "cancelled":
            raise concurrent.futures.CancelledError(self.key)
        return f"row of {self.key}, {self.status}".encode()


class CompletedFutures(list[Future]):
    """Futures in the order of completion; a future that is added again is in its next state."""

    def __init__(self, *, loop: object) -> None:
        self._keys: set[str] = set()

    def add(self, future: Future) -> None:
        if future.key in self._keys:
            future.next_state()
        self._keys.add(future.key)
        self.append(future)

    def __next__(self) -> Future:
        return self.pop(0)


def cluster_of(client: Any) -> clusters.Cluster:
    cluster = object.__new__(clusters.Cluster)
    work = Work("", "", "")
    cluster.__dict__.update(_client=client, _name="tcp://there:1", _work=work, _looked=math.inf, _capacity=clusters.LEAST)
    cluster._distributed = types.SimpleNamespace(as_completed=CompletedFutures, KilledWorker=RuntimeError)
    return cluster


def test_an_answer_lost_with_its_worker_is_awaited_again() -> None:
    states = iter([("finished",), ("lost", "pending", "finished"), ("finished",)])
    client = types.SimpleNamespace(loop=None, submit=lambda *_, key, pure: Future(key, *next(states)))
    answers = list(cluster_of(client).answers(((number, None) for number in range(3)), 3))
    assert [number for number, _ in answers] == [0, 2, 1]
    assert all(row.endswith(b"finished") for _, row in answers)


def test_a_run_that_the_scheduler_has_cancelled_ends_the_study() -> None:
    client = types.SimpleNamespace(loop=None, submit=lambda *_, key, pure: Future(key, "cancelled"))
    with pytest.raises(WorkersGoneError, match="the cluster at tcp://there:1 is gone"):
        list(cluster_of(client).answers([(0, None)], 1))


@pytest.mark.parametrize("call", ["submit", "nthreads"])
@pytest.mark.parametrize("error", [OSError("in <TCP>: Stream is closed"), TimeoutError(), RuntimeError("closed")])
def test_a_dead_scheduler_is_named_with_the_way_to_resume(
    call: str, error: Exception, dask: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = list[str]()
    real = getattr(importlib.import_module("distributed").Client, call)

    def dies(self: Any, *arguments: Any, **named: Any) -> Any:
        calls.append(call)
        if len(calls) > 2:
            raise error
        return real(self, *arguments, **named)

    monkeypatch.setattr(f"distributed.Client.{call}", dies)
    monkeypatch.setattr(clusters, "LEAST", 1)
    monkeypatch.setattr(clusters, "LOOK_EVERY_S", 0.0)
    (tmp_path / "two.toml").write_text(tomli_w.dumps(two()))
    command = ["study", str(tmp_path / "two.toml"), "--seeds", "20", "--vary", f"{LOSS}=0.1", "--out", str(tmp_path / "study")]
    found = vcmvsp_command(*command, "--metric", "radio.frames", "--cluster", dask.scheduler_address, "--quiet")
    assert (found.code, found.out) == (1, "")
    assert re.fullmatch(
        r"vcmvsp: the cluster at tcp://\S+ is gone: \d+ of 20 runs are done; the same command with --resume goes on\s",
        found.err,
    )


def test_a_cluster_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "TIMEOUT_S", 1)
    with pytest.raises(UsageError, match=r"--cluster tcp://127\.0\.0\.1:1: no Dask scheduler answers there within 1 s"):
        study(two(), vary=VARY, seeds=1, cluster="tcp://127.0.0.1:1")


def test_a_silent_cluster_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clusters, "TIMEOUT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # accepts, but never answers
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(UsageError, match=rf"--cluster {address}: no Dask scheduler answers there within 1 s"):
            study(two(), vary={LOSS: [0.0]}, seeds=1, cluster=address)


def test_without_dask_installation_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"in the checkout, pip install .*\[cluster\]"):
        study(two(), vary=VARY, seeds=1, cluster="tcp://127.0.0.1:1")
