"""`Setup`: a planned recording, and simulated recordings of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.choices import Mode
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence, detector_point
from rtof_kin.data.poses import PoseSequence
from rtof_kin.plan.protocol import DETECTORS
from rtof_kin.recording.recording import Recording
from rtof_kin.simulation.detector_errors import DetectorErrors
from rtof_kin.simulation.simulate import SimulationSettings, another_person, simulate
from rtof_kin.vision.detections import Detections
from rtof_kin.vision.keypoints import keypoints_from_detections
from rtof_kin.vision.layouts import detector_table

_MEASURED: Final = DETECTORS[0]


@dataclass(frozen=True)
class Setup:
    """A movement, and what records it."""

    poses: PoseSequence
    """(T, J) the movement at the video's rate, finite everywhere, world z up."""
    skeleton: SkeletonModel
    """Of the person."""
    camera: Camera
    sensors: tuple[str, ...]
    """Names of the skeleton's table."""
    detector: str = _MEASURED
    """One of `protocol.DETECTORS`."""
    error_factor: float = 1.0
    """[1] on the errors in the image of the measured detector."""
    floor_height: float | None = None
    """[m] z of a flat floor that the recording declares; None if it declares none."""

    @property
    def mode(self) -> Mode:
        """Mode of its reconstruction."""
        return "rtof" if self.sensors else "rto"

    def recorded(self, seed: int, late: bool = True) -> Recording:
        """Simulate a recording with the errors of a real detector and of real sensors.

        Each seed is another person, with a neutral posture of their own, another detector and other sensors.
        Equal seeds draw equal errors, whatever camera and sensors: differences between setups are theirs.

        Args:
            seed: of the person's and the recording's errors.
            late: whether the detector's frames are late, as they are by one to three of 60 Hz.

        Raises:
            InvalidInputError: the person is not in the camera's view, or the movement is too short.
        """
        f = self.error_factor
        errors = DetectorErrors(view=f, constant=f, coloured=f, jumps=f)
        errors = errors if late else replace(errors, delay_frames=(0,))
        poses = another_person(np.random.default_rng([seed, 1]), self.poses, self.skeleton)
        recording = simulate(
            poses,
            self.skeleton.joint_offsets,
            camera=self.camera,
            skeleton=self.skeleton,
            seed=seed,
            settings=SimulationSettings(keypoints=errors, sensors=self.sensors),
            name="plan",
        )
        recording = replace(recording, floor_height=self.floor_height)
        if self.detector == _MEASURED:
            return recording
        return replace(recording, keypoints=_as_found_by(self.detector, recording.video))


def _as_found_by(detector: str, keypoints: KeypointSequence) -> KeypointSequence:
    """The keypoints of a detector that finds some of the measured one's points."""
    own = keypoints.select([detector_point(_MEASURED, point) for point in detector_table().layout(detector).points])
    found = Detections(own.uv_px[:, None], own.confidence[:, None])
    return keypoints_from_detections(found, keypoints.times, keypoints.camera, detector).keypoints


def seen_share(setup: Setup) -> float:
    """Return the share of the joints' positions inside the camera's image, over the movement."""
    uv = setup.camera.project(setup.poses.p_world_joint)
    size = np.array([setup.camera.width_px, setup.camera.height_px])
    return float(np.mean(((uv >= 0) & (uv <= size)).all(axis=-1)))
