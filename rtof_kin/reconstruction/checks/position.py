"""How far off positions in world may be: what a recording leaves open of its camera and its body.

The camera, the floor and the size of the body are declared. Where the true ones differ by theta from these,
the motion is off by the sum of displacements d_k theta_k:

::

    focal length, log     -z forward                 pitch, roll    rotations about the camera's centre
    size of the body, log -(p - centre)              height         -up
    principal point, rad   z right, z down           heading        a rotation about the vertical

with z the depth of a joint. The evidence r of `camera_evidence` is J theta and errors of covariance W; before
it, theta is N(0, P). The mean square of theta, about the declared values, is then

::

    M = C + m m'      C = (J' W^-1 J + P^-1)^-1      m = C J' W^-1 r

(Rasmussen and Williams 2006, eq. 2.8), and d M d' is added to the covariances of positions in world; those
relative to the root stay. The camera's place on the floor and, without sensors, its heading are the choice of
the world's axes: positions are relative to them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from rtof_kin.calibration.camera_estimate import (
    CAMERA_UNKNOWNS,
    DOWN,
    FOCAL,
    HEADING,
    HEIGHT,
    PITCH,
    RIGHT,
    ROLL,
    SIZE,
    STATED,
    displacements,
    sigma_of,
)
from rtof_kin.core.array_types import Array
from rtof_kin.data.camera import Camera
from rtof_kin.data.confidence import BAND_95, Confidence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.initial_poses import refit_root
from rtof_kin.reconstruction.camera_evidence import Scene, floor_plane, lasting, turn_of_image, walk
from rtof_kin.reconstruction.checks.image import STEP, ImageExcerpt
from rtof_kin.recording.recording import Recording

SIZE_BY_HEIGHT: Final = 0.03  # [1] Standard deviation of the size of a body whose height is declared
TURN: Final = np.radians([2.4, 3.0, 1.8])
"""[rad] Standard deviations (3,) of the rotation between image and sensors with the true camera."""
_SEEN_PITCH = 0.5  # Share of a wrong pitch by which a lifted body is turned: it is lifted to stand on its feet
_LONGEST: Final = float(np.expm1(BAND_95 * 0.12) / (BAND_95 * 0.12))
"""Factor on changes of scale: those at the upper end of a band of a logarithm."""
_MENTIONED, _BESIDE = 0.5, 0.2
"""Share of the position's other errors from which an open quantity is named; and of the largest one's from
which others are named beside it."""


@dataclass(frozen=True)
class PositionErrors:
    """What a recording leaves open of its camera and its body, by the order of `CAMERA_UNKNOWNS`."""

    camera: Camera
    moment: Array  # (9, 9) M
    elsewhere: Array  # (9,) standard deviations that the covariances of an estimated camera contain already
    unverified: str = ""  # What makes positions in world uncertain, and what helps; empty where nothing does

    @classmethod
    def declared(cls, recording: Recording) -> Self:
        """Return what is open of a recording without any evidence."""
        camera = recording.video.camera
        return cls(camera, np.diag(_declared_sigma(recording) ** 2), sigma_of(camera.uncertainty))

    def added(self, confidence: Confidence, poses: PoseSequence) -> tuple[Confidence, Self]:
        """Return covariances in world with what is open, and this with it in words."""
        d = displacements(self.camera, poses.p_world_joint)
        if not np.isfinite(confidence.position_covariance[:, 0]).any() or not np.isfinite(d[:, 0]).any():
            return confidence, self  # nothing is known of the position anyway
        d[..., [FOCAL, SIZE]] *= _LONGEST
        own = float(np.nanmean(np.trace(confidence.position_covariance[:, 0], axis1=-2, axis2=-1)))
        open_ = np.nanmean((d[:, 0] ** 2).sum(axis=1), axis=0) * (np.diag(self.moment) + self.elsewhere**2)
        worst = int(open_.argmax())
        named = [CAMERA_UNKNOWNS[i].name for i in np.argsort(-open_) if open_[i] > _BESIDE**2 * open_[worst]]
        named = list(dict.fromkeys(named))
        more = d @ self.moment @ np.swapaxes(d, -1, -2)
        position = confidence.position_covariance + np.nan_to_num((more + np.swapaxes(more, -1, -2)) / 2)
        remedy = CAMERA_UNKNOWNS[worst].remedy
        if self.camera.uncertainty is not None:
            remedy = remedy.replace(STATED, "calibrate it with a chessboard")
        what = " and ".join(filter(None, (", ".join(named[:-1]), named[-1])))
        verb = "is" if len(named) == 1 else "are"
        words = f"{what} {verb} not checked ({remedy})" if open_[worst] > _MENTIONED**2 * own else ""
        return confidence.changed(position_covariance=position), replace(self, unverified=words)

    def seen(self, scene: Scene, keypoints: KeypointSequence, poses: PoseSequence, image: ImageExcerpt) -> Self:
        """Return what the evidence of a recording leaves open; `image` is an excerpt, lifted without sensors."""
        camera, size = keypoints.camera, len(CAMERA_UNKNOWNS)
        feet = scene.skeleton.index(*scene.contacts.joints)
        ankles = refit_root(poses, keypoints, sigma_depth=1.0).p_world_joint[:, feet][scene.contacts.standing]
        floor = scene.floor_height
        plane = floor_plane(camera, ankles, floor or 0.0)
        rows = []
        if plane is not None:
            own = slice(0 if floor is not None else 1, None)
            slopes = plane.fit @ displacements(camera, plane.p)[:, 2]
            rows += [(plane.evidence.value[own], plane.evidence.sigma[own], slopes[own])]
        paths = walk(scene, camera, poses)
        rows += [(paths.value, paths.sigma, -1.0 * (np.arange(size) == FOCAL)[None])]
        J = np.zeros((3, size))
        J[0, PITCH], J[2, ROLL] = _SEEN_PITCH, 1.0
        J[:, HEADING], J[1, RIGHT], J[0, DOWN] = camera.R_camera_world[:, 2], 1.0, -_SEEN_PITCH
        turn = np.full(3, np.nan)
        if image.lifted is not None and image.bone_imus is not None:
            turn = turn_of_image(image.bone_imus, scene.skeleton, image.keypoints.camera, image.lifted.poses)
        rows += [(turn, TURN * lasting(STEP * len(image.keypoints)), J)]
        value, errors, J = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        weight = np.where(np.isfinite(value), 1 / errors**2, 0.0)
        S = np.sqrt(self.moment)  # C = S (1 + S J' W^-1 J S)^-1 S, also where a sigma is 0
        C = S @ np.linalg.solve(np.eye(size) + S @ (J.T * weight) @ J @ S, S)
        m = C @ (J.T * weight) @ np.nan_to_num(value)
        return replace(self, moment=C + np.outer(m, m))


def _declared_sigma(recording: Recording) -> Array:
    """Standard deviations (9,) of what a recording declares; 0 where another estimate has it."""
    camera, sigma = recording.video.camera, np.array([unknown.declared for unknown in CAMERA_UNKNOWNS])
    of_camera = [FOCAL, PITCH, ROLL, HEIGHT]
    if recording.height is not None:
        sigma[SIZE] = SIZE_BY_HEIGHT
    if camera.accuracy is not None:
        sigma[of_camera] = sigma_of(camera.accuracy)[of_camera]
        sigma[HEADING], sigma[[RIGHT, DOWN]] = camera.accuracy.tilt, camera.accuracy.focal
    if recording.imus is None:
        sigma[HEADING] = 0.0
    if camera.uncertainty is not None:
        sigma[[*of_camera, HEADING]] = 0.0
    return sigma
