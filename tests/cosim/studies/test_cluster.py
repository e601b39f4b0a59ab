"""Studies on a cluster: two Dask workers on this machine."""

import functools
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.cosim.studies import ESTIMATOR, LOSS, mine, two
from vcmvsp.cosim.errors import UsageError
from vcmvsp.cosim.studies import cluster as clusters
from vcmvsp.cosim.studies.engine import study

VARY: dict[str, list[Any]] = {LOSS: [0.0, 0.4], ESTIMATOR: ["hold", "dr"]}
pytestmark = pytest.mark.filterwarnings("ignore")  # those of the library are not ours to mend


@pytest.fixture(scope="module")
def dask() -> Iterator[Any]:
    distributed = pytest.importorskip("distributed")
    import dask as library

    library.config.set({"distributed.scheduler.allowed-failures": 0})  # a death is enough: each costs a new worker
    with distributed.LocalCluster(n_workers=2, threads_per_worker=2, processes=True, dashboard_address=None) as cluster:
        yield cluster


def test_rows_are_those_of_this_machine_byte_for_byte(dask: Any, tmp_path: Path) -> None:
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


def test_a_cluster_that_does_not_answer_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "TIMEOUT_S", 1)
    begin = time.monotonic()
    with pytest.raises(UsageError, match=r"--cluster tcp://127\.0\.0\.1:1: no Dask scheduler answers there within 1 s"):
        study(two(), vary=VARY, seeds=1, cluster="tcp://127.0.0.1:1")
    assert time.monotonic() - begin < 30


def test_a_cluster_that_says_nothing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr(clusters, "TIMEOUT_S", 1)
    with socket.create_server(("127.0.0.1", 0)) as silent:  # it accepts
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(UsageError, match=rf"--cluster {address}: no Dask scheduler answers there within 1 s"):
            study(two(), vary={LOSS: [0.0]}, seeds=1, cluster=address)


def test_workers_that_say_nothing_are_named(dask: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check = clusters.Cluster._check_versions

    def hurried(cluster: clusters.Cluster) -> None:
        with monkeypatch.context() as patch:
            patch.setattr(clusters, "TIMEOUT_S", 1)
            check(cluster)

    waits = ["sh", "-c", f"until [ -e '{tmp_path}/go' ]; do sleep 0.1; done"]
    monkeypatch.setattr(clusters.Cluster, "_check_versions", hurried)
    monkeypatch.setattr(clusters, "version", functools.partial(subprocess.run, waits, check=True))
    with pytest.raises(UsageError, match=r"a worker cannot run vcmvsp \(TimeoutError: it says nothing\)"):
        study(two(), vary={LOSS: [0.0]}, seeds=1, cluster=dask.scheduler_address)
    (tmp_path / "go").touch()


def test_without_dask_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(UsageError, match=r"in the checkout, pip install .*\[cluster\]"):
        study(two(), vary=VARY, seeds=1, cluster="tcp://127.0.0.1:1")
