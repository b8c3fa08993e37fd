"""Fixtures of many tests: shipped skeletons, a motion, a camera; one cache of compiled code for all tests."""

from __future__ import annotations

import os
from pathlib import Path
from tempfile import TemporaryDirectory

import planted
import pytest
from hypothesis import settings

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.camera import Camera

CACHE = "RTOF_KIN_CACHE"

# One commit has one verdict: examples follow from the test. New ones: pytest --hypothesis-profile=default.
settings.register_profile("same", derandomize=True)
settings.load_profile("same")


def pytest_configure(config: pytest.Config) -> None:
    """All processes of the session share one cache of compiled code, empty at its start."""
    if not hasattr(config, "workerinput") and CACHE not in os.environ:
        folder = TemporaryDirectory(prefix="rtof_kin_tests_")
        config.add_cleanup(folder.cleanup)
        os.environ[CACHE] = folder.name


@pytest.fixture(scope="session")
def skeleton() -> SkeletonModel:
    """The 21-joint Total Capture skeleton."""
    return SkeletonModel.default()


@pytest.fixture(params=["total_capture", "human36m"], scope="session")
def any_skeleton(request: pytest.FixtureRequest) -> SkeletonModel:
    """Each shipped skeleton in turn."""
    return SkeletonModel.named(request.param)


@pytest.fixture(scope="session")
def motion(skeleton: SkeletonModel) -> Motion:
    """One second of smooth random motion about standing, 60 Hz, completely observed."""
    return planted.seen(skeleton, 60)


@pytest.fixture(scope="session")
def camera() -> Camera:
    """One camera 4 m away at 1.5 m."""
    return planted.camera()


@pytest.fixture
def compile_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of compiled functions, not created yet; compilation is turned on."""
    folder = tmp_path / "cache"
    monkeypatch.setenv(CACHE, str(folder))
    monkeypatch.delenv("RTOF_KIN_COMPILE", raising=False)
    return folder
