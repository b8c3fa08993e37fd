"""What the last bits depend on: complete and without names."""

from __future__ import annotations

import getpass
import platform
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path

import numpy as np
import planted
import pytest
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.environment import environment, source_digest
from rtof_kin.solve.fragment_solver import FragmentSolver
from rtof_kin.solve.settings import CartesianSettings, JointSpaceSettings


def test_environment_has_versions_and_neither_names_nor_paths(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.setenv("OPENBLAS_CORETYPE", "Haswell")
    found = environment()
    assert found["instructions"] == "OPENBLAS_CORETYPE=Haswell"
    assert found["numpy"] == np.__version__
    assert found["python"] == platform.python_version()
    assert found["threads"] == "3"
    assert np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"] in found["BLAS of numpy"]
    assert len(found["rtof_kin source"]) == 16
    text = "\n".join(found.values())
    assert str(Path.home()) not in text
    assert (platform.node() or "-") not in text.split()
    assert getpass.getuser() not in text.split()


SOURCES = {
    "rtof_kin/solver.py": "code",
    "rtof_kin/numerics/simd.h": "code",
    "rtof_kin/datasets/public_sets.toml": "a table",
    "models/joints.toml": "a table",
    "models/movements/gait.npz": "a table",
}


def digest(root: Path, files: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> str:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    monkeypatch.setattr("rtof_kin.core.environment._ROOT", root)
    return source_digest.__wrapped__()


@pytest.mark.parametrize("changed", SOURCES)
def test_source_digest_tells_code_and_tables_apart(
    changed: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = digest(tmp_path, SOURCES, monkeypatch)
    assert digest(tmp_path, {changed: "other"}, monkeypatch) != before


def test_source_digest_of_a_checkout_is_that_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checkout = SOURCES | {"models/build_joints.py": "not packaged", "README.md": "not packaged"}
    package = {f"rtof_kin/{name}" if name.startswith("models/") else name: text for name, text in SOURCES.items()}
    assert digest(tmp_path / "a", checkout, monkeypatch) == digest(tmp_path / "b", package, monkeypatch)


Array = NDArray[np.float64]
BODY = SkeletonModel.default()
BODIES = (BODY, BODY.with_height(1.6), BODY)
N, FRAMES = 8, 12
SETTINGS: dict[str, JointSpaceSettings | CartesianSettings] = {
    "joint": JointSpaceSettings(),
    "cartesian": CartesianSettings(),
}


def solve(kind: str, i: int, solver: FragmentSolver | None = None) -> Array:
    """Positions of the i-th recording, of a body and a motion of its own."""
    body = BODIES[i]
    truth = planted.human(body, FRAMES, seed=i)
    seen = planted.keypoints(truth.poses, 2.0, seed=i)
    imus = planted.bone_imus(body, truth.poses, degrees=3.0, seed=i)
    solver = solver or FragmentSolver(body, N, SETTINGS[kind])
    start = planted.human(body, FRAMES, seed=i, size=0.9).poses
    return solver.solve(start, seen, imus).poses.p_world_joint


@cache
def one_after_the_other(kind: str) -> list[Array]:
    return [solve(kind, i) for i in range(3)]


@pytest.mark.parametrize("kind", SETTINGS)
def test_three_threads_give_the_results_of_one(kind: str) -> None:
    expected = one_after_the_other(kind)
    with ThreadPoolExecutor(3) as pool:
        for found, alone in zip(pool.map(lambda i: solve(kind, i), range(3)), expected, strict=True):
            np.testing.assert_array_equal(found, alone)
