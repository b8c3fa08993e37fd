"""Short reconstructions by a lifter whose errors are planted."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import planted

from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording

BODY = SkeletonModel.default()
FRAMES = 40
SETTINGS = ReconstructionSettings(frames=16)
QUICK_PRIORS = replace(CalibrationPriors(), sigma_swing=None, sigma_image_bias=None)
"""Few unknowns."""
TRUNK = BODY.index("Hips", "Spine", "Spine1", "Neck", "Head", "LeftShoulder", "RightShoulder")


def run(recording: Recording, truth: MotionSequence, mode: str = "rtof", **options: Any) -> Reconstruction:
    """`reconstruct` with `planted.PlantedLifter` and without calibration, unless the options differ."""
    usual = {"lifter": planted.PlantedLifter(truth), "settings": SETTINGS, "calibrate": False}
    return reconstruct(recording, mode=mode, **(usual | options))  # type: ignore[arg-type]
