"""Fixtures of many tests: shipped skeletons, a motion, a camera, an empty cache of compiled code."""

from __future__ import annotations

import os
from pathlib import Path

import planted
import pytest

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.camera import Camera

os.environ.setdefault("RTOF_KIN_COMPILE", "never")
"""Compiling takes longer than the tests; the fixture `compile_cache` turns it on."""


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
    monkeypatch.setenv("RTOF_KIN_CACHE", str(folder))
    monkeypatch.delenv("RTOF_KIN_COMPILE", raising=False)
    return folder
