"""A batch on a Ray cluster, one of whose nodes is killed while it works."""

from __future__ import annotations

import os
import secrets
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import batch_support
import pytest
from batch_support import batch_of, calls, facts, obey, write_recordings

from rtof_kin.batch.run import run_batch
from rtof_kin.core.jobs import RayCluster

pytestmark = pytest.mark.filterwarnings("ignore")  # of Ray's own
ONE_CORE: dict[str, Any] = {"num_cpus": 1, "object_store_memory": 80 * 2**20}


@pytest.fixture
def cluster(log: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head without cores; workers can import the tests' commands."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    path = [str(Path(batch_support.__file__).parent), *sys.path]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    # Ray reads the token when it is imported.
    pytest.importorskip("ray", reason="Ray is not installed: pip install rtof-kin[cluster]")
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args=ONE_CORE | {"num_cpus": 0, "include_dashboard": False})
    yield made
    made.shutdown()


@pytest.mark.slow
def test_a_node_that_is_killed_costs_no_recording(cluster: Any, tmp_path: Path, out: Path, log: Path) -> None:
    root = write_recordings(tmp_path / "takes", bad="refuse", r0="pass", r1="pass", z="pass endless")
    node = cluster.add_node(**ONE_CORE)
    began = log / "endless"

    def replace_node(done: int, total: int, text: str) -> None:
        if done == 3:  # the last one is at work
            while not began.is_file():
                time.sleep(0.05)
            cluster.add_node(**ONE_CORE)
            cluster.remove_node(node, allow_graceful=False)

    engine = RayCluster(cluster.address, memory_per_job=1e8)
    rows = run_batch(batch_of(root, out), obey, engine, progress=replace_node)
    began.unlink()
    good = ("r0", "r1", "z")
    assert facts(rows) == {"bad": "error", **dict.fromkeys(good, "pass")}
    assert all((out / name / "report.html").is_file() for name in good)
    before = calls(log)
    assert {name: before[f"{name} reconstruct"] for name in good} == {"r0": 1, "r1": 1, "z": 2}
    again = run_batch(batch_of(root, out), obey, RayCluster(cluster.address))
    assert facts(again) == facts(rows)
    assert calls(log) - before == {"bad reconstruct": 1}
