"""One planted motion and its recording, shared by the tests of the stages."""

from __future__ import annotations

import planted
import pytest
from reconstruction_support import BODY, FRAMES

from rtof_kin.body.skeleton import MotionSequence
from rtof_kin.recording.recording import Recording


@pytest.fixture(scope="session")
def truth() -> MotionSequence:
    return planted.human(BODY, FRAMES)


@pytest.fixture(scope="session")
def recording(truth: MotionSequence) -> Recording:
    return planted.recording(truth, sigma_px=3.0, degrees=3.0)
