"""A planted motion, its recording, and reconstructions of it by a lifter whose errors are planted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import planted

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.core import rotations as so3
from rtof_kin.core.choices import Mode
from rtof_kin.reconstruction.lift import Lifted, lift
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.prepare import Job, Prepared
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording

BODY = SkeletonModel.default()
FRAMES = 40
SETTINGS = ReconstructionSettings(frames=16)
QUICK_PRIORS = replace(CalibrationPriors(), sigma_swing=None, sigma_image_bias=None)
"""Few unknowns."""
TRUNK = BODY.index("Hips", "Spine", "Spine1", "Neck", "Head", "LeftShoulder", "RightShoulder")
TURN = so3.exp([0.1, -0.05, 0.15])
"""Error of planted orientations, in the segments' axes."""


@dataclass(frozen=True)
class Case:
    """A planted motion and its recording."""

    truth: Motion
    recording: Recording

    def changed(self, **fields: Any) -> Self:
        """The same with other fields of the recording."""
        return replace(self, recording=replace(self.recording, **fields))

    def lifter(self, **how: Any) -> planted.PlantedLifter:
        return planted.PlantedLifter(self.truth, **how)

    def lift(self, lifter: planted.PlantedLifter) -> Lifted:
        return lift(self.recording.video, BODY, lifter)

    def prepare(self, mode: Mode, lifter: Any = None, settings: Any = SETTINGS) -> Prepared:
        return Job.of(self.recording, BODY, lifter or self.lifter(), settings, None).prepare(mode)

    def run(self, mode: str = "rtof", **options: Any) -> Reconstruction:
        """Reconstruct without calibration, unless the options differ."""
        usual = {"lifter": self.lifter(), "settings": SETTINGS, "calibrate": False}
        return reconstruct(self.recording, mode=mode, **(usual | options))  # type: ignore[arg-type]
