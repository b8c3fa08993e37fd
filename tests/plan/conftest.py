"""A planned recording of more than a second of the demo's movement."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rtof_kin.core.resources import model_path
from rtof_kin.plan.setup import Setup
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.simulate import LIMB_SENSORS


@pytest.fixture(scope="session")
def setup() -> Setup:
    """As the demo was recorded, with the eight sensors of the limbs."""
    demo = Recording.load(model_path("demo"))
    assert demo.truth is not None
    poses = demo.truth[:80]
    poses = replace(poses, times=poses.times - poses.times[0])
    return Setup(poses, demo.skeleton, demo.video.camera, LIMB_SENSORS)
