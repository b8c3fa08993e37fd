"""Fixtures of many tests: shipped skeletons, a motion, a camera, and which energies are compiled."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import planted
import pytest
from hypothesis import settings

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.core.environment import keep_freed_memory
from rtof_kin.core.jobs.engine import cores_limited
from rtof_kin.core.numerics import banded, c_compiler
from rtof_kin.core.resources import cache_folder
from rtof_kin.data.camera import Camera
from rtof_kin.inertial.root_path import FEET
from rtof_kin.solve.joint_space import fragment, terms
from rtof_kin.solve.settings import JointSpaceSettings
from rtof_kin.solve.terms import Term

CACHE, COMPILE = "RTOF_KIN_CACHE", "RTOF_KIN_COMPILE"
SENSED = tuple(sorted(SkeletonModel.default().index(*planted.LIMBS)))
USUAL = (
    terms.Visual(tuple((joint, True) for joint in range(21))),
    terms.Orientation(SENSED, JointSpaceSettings().robust_orientation),
    terms.Floor(tuple(SkeletonModel.default().index(*FEET)), JointSpaceSettings().floor_cutoff),
    terms.Acceleration(SENSED, JointSpaceSettings().robust_acceleration),
)
"""Terms of the energy of most tests, of the joints in one camera's image and of the eight sensors of the limbs."""

# One commit has one verdict: examples follow from the test, and none is too slow for a busy machine.
# New ones: pytest --hypothesis-profile=default.
settings.register_profile("same", derandomize=True, deadline=None)
settings.load_profile("same")


def pytest_configure(config: pytest.Config) -> None:
    """All processes of the session share one cache of compiled code, empty at its start."""
    os.environ.setdefault(COMPILE, "never")
    keep_freed_memory()
    one_core = cores_limited(1)  # the other one has tests of its own
    one_core.__enter__()
    config.add_cleanup(lambda: one_core.__exit__(None, None, None))
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


@pytest.fixture(scope="session", autouse=True)
def usual_energy() -> Iterator[None]:
    """The energy of most tests is compiled; compiling another one takes longer than the tests that use it.

    Energies are kept: were it left to the tests, that which comes first in its process would decide for all others.
    """
    made = fragment._functions

    def functions(name: str, own: tuple[Term, ...], moving: tuple[str, ...], hinges: bool, *how: Any) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            if len(own) == 8 and {*USUAL} < {*own} and hinges:
                patch.delenv(COMPILE, raising=False)
                patch.setattr(c_compiler._log, "disabled", True)
            return made(name, own, moving, hinges, *how)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fragment, "_functions", functions)
        patch.setattr(banded, "_code", lambda: banded._opened(cache_folder()))
        yield


@pytest.fixture
def compile_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of compiled functions, not created yet; compilation is turned on."""
    folder = tmp_path / "cache"
    monkeypatch.delenv(COMPILE, raising=False)
    monkeypatch.setenv(CACHE, str(folder))
    return folder
