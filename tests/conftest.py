"""Fixtures of many tests: shipped skeletons, a motion, a camera; energies are interpreted but where a test compiles."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import planted
import pytest
from hypothesis import settings

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.data.camera import Camera

CACHE, COMPILE = "RTOF_KIN_CACHE", "RTOF_KIN_COMPILE"

# One commit has one verdict: examples follow from the test. New ones: pytest --hypothesis-profile=default.
settings.register_profile("same", derandomize=True)
settings.load_profile("same")


def pytest_configure(config: pytest.Config) -> None:
    """All processes of the session share one cache of compiled code, empty at its start.

    Compiling an energy takes longer than most tests that use it; `compiled` and `compile_cache` turn it on.
    """
    os.environ.setdefault(COMPILE, "never")
    gc.disable()  # modules and items of a collection are not garbage; a third of its time
    config.option.loadscopereorder = False  # else files of few tests, some of which are long, come last
    if not hasattr(config, "workerinput") and CACHE not in os.environ:
        folder = TemporaryDirectory(prefix="rtof_kin_tests_")
        config.add_cleanup(folder.cleanup)
        os.environ[CACHE] = folder.name


def pytest_collection_finish() -> None:
    """Modules and items stay to the end: the garbage collector need not look at them again and again."""
    gc.freeze()
    gc.enable()


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


@pytest.fixture(scope="module")
def compiled() -> Iterator[None]:
    """Compilation turned on for the tests of a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv(COMPILE, raising=False)
        yield


@pytest.fixture
def compile_cache(compiled: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of compiled functions, not created yet; compilation is turned on."""
    folder = tmp_path / "cache"
    monkeypatch.setenv(CACHE, str(folder))
    return folder
