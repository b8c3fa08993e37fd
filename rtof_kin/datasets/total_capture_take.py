"""One take of Total Capture in this package's frames, and the recordings it gives."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.core.plausibility import Check
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.datasets.total_capture_checks import check_camera, check_keypoints, check_take
from rtof_kin.datasets.total_capture_files import MISCALIBRATED
from rtof_kin.datasets.total_capture_truth import RATE_HZ
from rtof_kin.recording.recording import Recording

Array = NDArray[np.float64]
ACKNOWLEDGEMENT = (
    "Total Capture: M. Trumble, A. Gilbert, C. Malleson, A. Hilton, J. Collomosse, 'Total Capture: 3D "
    "Human Pose Estimation Fusing Video and Inertial Sensors', BMVC 2017. Research use only."
)


@dataclass(frozen=True)
class Take:
    """One take: what Vicon saw, what the sensors gave, and the cameras around."""

    subject: str
    """S1 to S5."""
    name: str
    """Such as acting3."""
    truth: PoseSequence
    """Poses at 60 Hz from time 0; not `valid` where the reference is known to jump."""
    joint_offsets: Array
    """(J, 3) each joint in its parent's link frame, m, measured in this take."""
    spread_mm: float
    """Largest standard deviation of an offset, mm; NaN where orientations were derived."""
    imus: ImuSequence | None
    """The sensors that have a calibration; None where there are none. Without acceleration in the first
    ten frames, in which a foot may be stamped while the pose stands still."""
    calibration: ImuCalibration | None
    """Of those sensors, from the take's own files; lever arms are the skeleton's usual ones."""
    cameras: Mapping[int, Camera]
    """By number, 1 to 8; empty without a camera calibration."""
    missing: tuple[str, ...]
    """What was not found."""
    notes: tuple[str, ...]
    """What was derived, mended or left out."""

    @cached_property
    def skeleton(self) -> SkeletonModel:
        """The subject's skeleton in this take."""
        return SkeletonModel.default().with_offsets(self.joint_offsets)

    def recording(
        self,
        camera: int,
        keypoints: KeypointSequence | None = None,
        noise_px: float = 0.0,
        seed: int = 0,
        sensors: Sequence[str] | None = None,
    ) -> Recording:
        """The take as one camera and some of the sensors recorded it.

        Args:
            camera: number, 1 to 8. keypoints: a detector's, of this camera's video; where not given,
                the true joints as the camera sees them, outside of the picture too.
            noise_px: standard deviation of white noise on true joints, px per axis.
            seed: of the noise; every take and camera has its own.
            sensors: names; all there are where not given.

        Returns:
            With the truth, cut to the shorter of video and reference.

        Raises:
            UnknownNameError: no such camera or sensor.
            InvalidInputError: keypoints of other times; noise that is negative or on a detector's keypoints.
        """
        self._check_camera(camera)
        if not noise_px >= 0 or not np.isfinite(noise_px):
            raise InvalidInputError(f"noise_px: {noise_px:g} is not a standard deviation")
        if seed < 0:
            raise InvalidInputError(f"seed: {seed} is negative")
        if noise_px and keypoints is not None:
            raise InvalidInputError("noise_px: noise is added to true joints only, not to a detector's")
        if keypoints is None:
            keypoints = self._projected(camera, noise_px, seed)
        truth = self._cut_to(keypoints)
        imus, calibration = self._sensors(sensors)
        notes = [*self.notes, *self.missing]
        if len(keypoints) != len(self.truth):
            notes.append(f"video of {len(keypoints)} frames, reference of {len(self.truth)}: cut")
        if camera in MISCALIBRATED:
            notes.append(MISCALIBRATED[camera])
        return Recording(
            name=f"{self.subject} {self.name} cam{camera}",
            keypoints=keypoints[: len(truth)],
            imus=imus,
            calibration=calibration,
            joint_offsets=self.joint_offsets,
            truth=truth,
            acknowledgement=ACKNOWLEDGEMENT,
            notes="; ".join(notes),
        )

    def check(
        self, camera: int | None = None, keypoints: KeypointSequence | None = None
    ) -> tuple[Check, ...]:
        """Whether what the files say fits together.

        Args:
            camera: number of one that shall be checked as well. keypoints: a detector's, of its video.

        Raises:
            UnknownNameError: no such camera. InvalidInputError: keypoints without a camera.
        """
        checks = check_take(self)
        if camera is not None:
            self._check_camera(camera)
            checks += check_camera(camera)
        if keypoints is not None:
            if camera is None:
                raise InvalidInputError("keypoints: name the camera whose video they were detected in")
            checks += check_keypoints(self, camera, keypoints)
        return tuple(checks)

    def _check_camera(self, camera: int) -> None:
        if camera not in self.cameras:
            known = [str(number) for number in self.cameras] or ["none, without calibration.cal"]
            raise UnknownNameError("camera", [str(camera)], known)

    def _projected(self, number: int, noise_px: float, seed: int) -> KeypointSequence:
        """The true joints as a camera sees them, with white noise."""
        camera = self.cameras[number]
        uv = camera.project(self.truth.p_world_joint)
        if noise_px:
            own = zlib.crc32(f"{self.subject} {self.name} {number}".encode())
            uv = uv + np.random.default_rng([seed, own]).normal(0, noise_px, uv.shape)
        confidence = np.isfinite(uv).all(axis=-1).astype(float)
        return KeypointSequence(camera, self.truth.times, uv, confidence, self.truth.names)

    def _cut_to(self, keypoints: KeypointSequence) -> PoseSequence:
        count = min(len(self.truth), len(keypoints))
        if not np.allclose(self.truth.times[:count], keypoints.times[:count], atol=0.1 / RATE_HZ):
            raise InvalidInputError(
                f"{self.subject} {self.name}: keypoints must begin at time 0 and have {RATE_HZ:g} "
                "samples a second, as the videos do"
            )
        return self.truth[:count]

    def _sensors(self, names: Sequence[str] | None) -> tuple[ImuSequence | None, ImuCalibration | None]:
        if names is not None and not names:
            return None, None
        if self.imus is None or self.calibration is None or names is None:
            return self.imus, self.calibration
        return self.imus.select(names), self.calibration.select(tuple(names))
