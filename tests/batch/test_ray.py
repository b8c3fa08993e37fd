"""A batch on a Ray cluster of two nodes, one of which is killed in the middle."""

from __future__ import annotations

import os
import secrets
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import batch_support
import pytest
from batch_support import batch_of, calls, facts, obey, write_recordings

from rtof_kin.batch.run import run_batch
from rtof_kin.core.jobs import RayCluster

pytestmark = pytest.mark.filterwarnings("ignore")  # of Ray's own


@pytest.fixture
def cluster(log: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A head and a node of one core each, whose workers can import the tests' commands."""
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    monkeypatch.setenv("RAY_AUTH_TOKEN", secrets.token_hex(32))
    path = [str(Path(batch_support.__file__).parent), *sys.path]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path))
    # Ray reads the token when it is imported.
    pytest.importorskip("ray", reason="Ray is not installed: pip install rtof-kin[cluster]")
    from ray.cluster_utils import Cluster

    size = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 80 * 2**20}
    made = Cluster(initialize_head=True, head_node_args=size)
    yield made
    made.shutdown()


@pytest.mark.slow
def test_a_node_that_is_killed_costs_no_recording(cluster: Any, tmp_path: Path, out: Path, log: Path) -> None:
    names = [f"r{k}" for k in range(8)]
    root = write_recordings(tmp_path / "takes", bad="refuse", **dict.fromkeys(names, "pass slow"))
    node = cluster.add_node(num_cpus=1, object_store_memory=80 * 2**20)

    def kill(done: int, total: int, text: str) -> None:
        if done == 3:
            cluster.remove_node(node, allow_graceful=False)

    rows = run_batch(batch_of(root, out), obey, RayCluster(cluster.address, memory_per_job=1e8), progress=kill)
    assert facts(rows) == {"bad": "error", **dict.fromkeys(names, "pass")}
    assert all((out / name / "report.html").is_file() for name in names)
    repeated = [name for name in names if calls(log)[f"{name} reconstruct"] > 1]
    assert len(repeated) <= 1  # the one that the node had
    before = calls(log)
    again = run_batch(batch_of(root, out), obey, RayCluster(cluster.address))
    assert facts(again) == facts(rows)
    assert calls(log) - before == {"bad reconstruct": 1}
