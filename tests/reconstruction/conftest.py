"""The planted recording of the tests of the stages, and the energy of a camera and eight sensors, compiled once."""

from __future__ import annotations

import planted
import pytest
from reconstruction_support import BODY, FRAMES, Case


@pytest.fixture(scope="module", autouse=True)
def usual_energy(compiled: None) -> None:
    """Compile; tests of other energies turn it off, as they have them for themselves."""


@pytest.fixture(scope="session")
def case() -> Case:
    truth = planted.human(BODY, FRAMES)
    return Case(truth, planted.recording(truth, sigma_px=3.0, degrees=3.0))
