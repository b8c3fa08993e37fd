"""One take of Total Capture in this package's frames, and its recordings."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.core.errors import InvalidInputError, UnknownNameError
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu import ImuSequence
from rtof_kin.data.imu_calibration import ImuCalibration
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
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
    """One take: reference poses, sensors and cameras."""

    subject: str
    """S1 to S5."""
    name: str
    """Such as acting3."""
    truth: PoseSequence
    """Poses at 60 Hz from time 0; not `valid` where the reference has a known glitch."""
    joint_offsets: Array
    """(J, 3) each joint in its parent's link frame, m, measured in this take."""
    spread_mm: float
    """Largest standard deviation of an offset, mm; NaN where orientations were derived."""
    imus: ImuSequence | None
    """The calibrated sensors; None where there are none. The acceleration of the first ten frames, in which
    a foot may be stamped, is NaN."""
    calibration: ImuCalibration | None
    """Calibration of those sensors, from the take's files; lever arms are those of the skeleton table."""
    cameras: Mapping[int, Camera]
    """By number, 1 to 8; empty without a camera calibration."""
    missing: tuple[str, ...]
    """Missing files."""
    notes: tuple[str, ...]
    """Derived, repaired and omitted data."""

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
        """Return the take as recorded by one camera and some sensors, with the truth.

        Args:
            camera: number, 1 to 8. sensors: names, by default all.
            keypoints: a detector's, of this camera's video; by default the projected joints, also outside
                the image. The recording ends with the shorter of keypoints and reference.
            noise_px: standard deviation of white noise on projected joints, px per axis.
            seed: of the noise; takes and cameras have different noise.

        Raises:
            UnknownNameError: no such camera or sensor. InvalidInputError: keypoints of other times, or
                negative noise or noise on a detector's keypoints.
        """
        self.camera(camera)
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

    def camera(self, number: int) -> Camera:
        """Return a camera.

        Args:
            number: 1 to 8.

        Raises:
            UnknownNameError: no such camera, or no calibration of the cameras.
        """
        if number not in self.cameras:
            known = [str(n) for n in self.cameras] or ["none, without calibration.cal"]
            raise UnknownNameError("camera", [str(number)], known)
        return self.cameras[number]

    def _projected(self, number: int, noise_px: float, seed: int) -> KeypointSequence:
        """Project the true joints and add white noise."""
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
