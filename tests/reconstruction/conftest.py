"""The planted recording of the tests of the stages."""

from __future__ import annotations

import planted
import pytest
from reconstruction_support import BODY, FRAMES, Case


@pytest.fixture(scope="session")
def case() -> Case:
    truth = planted.human(BODY, FRAMES)
    return Case(truth, planted.recording(truth, sigma_px=3.0, degrees=3.0))
