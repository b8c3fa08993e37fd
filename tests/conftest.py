"""What many tests need: the shipped skeletons, a motion, a camera."""

from __future__ import annotations

import os

import planted
import pytest

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.data.camera import Camera

os.environ.setdefault("RTOF_KIN_COMPILE", "never")
"""Compiling takes longer than what the tests solve; `test_compiled` turns it on."""


@pytest.fixture(scope="session")
def skeleton() -> SkeletonModel:
    """The 21-joint Total Capture skeleton."""
    return SkeletonModel.default()


@pytest.fixture(params=["total_capture", "human36m"], scope="session")
def any_skeleton(request: pytest.FixtureRequest) -> SkeletonModel:
    """Each shipped skeleton in turn."""
    return SkeletonModel.named(request.param)


@pytest.fixture(scope="session")
def motion(skeleton: SkeletonModel) -> MotionSequence:
    """One second of smooth random motion about standing at ease, 60 Hz, all of it seen."""
    return planted.seen(skeleton, 60)


@pytest.fixture(scope="session")
def camera() -> Camera:
    """One camera 4 m away at 1.5 m."""
    return planted.camera()
