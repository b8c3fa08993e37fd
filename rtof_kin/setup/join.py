"""Two recordings of one take, each with a camera of its own, become one with two views."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np

from rtof_kin.calibration.clocks import find_video_offset
from rtof_kin.calibration.second_camera import SecondCamera, estimate_second_camera
from rtof_kin.core.array_types import Array
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.camera import Camera
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.reconstruction.lift import LifterLike, lift
from rtof_kin.reconstruction.pipeline import reconstruct
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.vision.outlier_rejection import reject_keypoint_outliers

ABOUT: Final = "second camera"  #: What sentences on it begin with


def join_recordings(
    first: Recording, second: Recording, lifter: LifterLike | None = None, *, synchronised: bool = False
) -> Recording:
    """Join the videos of two cameras that saw the same person at the same time.

    Clocks are found from the movement. Two calibrated cameras are in one world already; of others the second
    one's pose, and both focal lengths, are found too (`find_second_camera`).

    `first`: with sensors or without; its camera defines the world. `lifter`: default: the shipped one.
    `InvalidInputError`: the second one has sensors, or no keypoints, or the clocks have too little in common;
    `CalibrationError`: the cameras do not see the person together for long enough.

    Returns:
        The first recording with the second camera's keypoints on its clock and that camera in its world; its notes
        begin with why this may be in doubt and end with what was estimated, with standard deviations.
    """
    if second.imus is not None:
        raise InvalidInputError(f"recording {second.name}: has sensors; give the one with sensors as the first")
    if _is_calibrated(first.video.camera) and _is_calibrated(second.video.camera):
        offset, sigma, doubt = 0.0, 0.0, ""
        if not synchronised:
            poses, others = (lift(k, first.skeleton, lifter).poses for k in (first.video, second.video))
            clock = find_video_offset(poses, others)
            offset, sigma, doubt = clock.offset, clock.sigma, clock.doubt
        view = second.video.on_clock(second.video.times + offset)
        joined, pose = replace(first, views=(*first.views, view)), "as calibrated"
    else:
        camera = find_second_camera(first, second.video, lifter, around=0.0 if synchronised else None)
        offset, sigma, doubt = camera.offset, camera.sigma_offset, camera.doubt
        joined = camera.apply(first)
        pose = (
            f"{_apart(camera.first, camera.view.camera)}, position ± {_rms(camera.sigma_position):.2f} m, "
            f"orientation ± {np.degrees(_rms(camera.sigma_turn)):.1f} degrees"
        )
    found = f"{ABOUT}: {pose}; the times of its video were moved by {offset:+.3f} ± {sigma:.3f} s"
    notes = [f"doubtful: {ABOUT}: {doubt}"] if doubt else []
    notes += [first.notes] if first.notes else []
    return replace(joined, notes="\n".join([*notes, f"found: {found}"]))


def find_second_camera(
    recording: Recording,
    second: KeypointSequence,
    lifter: LifterLike | None = None,
    *,
    around: float | None = None,
    sigma_focal: tuple[float, float] | None = None,
) -> SecondCamera:
    """Estimate a second camera, which stands anywhere, from the person who moves before both. `CalibrationError`,
    `InvalidInputError`: as there. Errors of the reconstruction.

    Args:
        recording: of the first camera, whose pose is the world's, with sensors or without; its skeleton,
            from the height, gives the scale.
        second, around, sigma_focal: as for `rtof_kin.calibration.second_camera.estimate_second_camera`.
        lifter: default: the shipped one.
    """
    sensed, skeleton = recording.imus is not None and recording.calibration is not None, recording.skeleton
    settings = ReconstructionSettings(confidence=False)
    alone = reconstruct(recording, mode="rtof" if sensed else "rto", lifter=lifter, settings=settings)
    assert alone.keypoints is not None
    second, _ = reject_keypoint_outliers(second)
    lifted = lift(second, skeleton, lifter).poses
    return estimate_second_camera(
        alone.keypoints,
        alone.motion.poses,
        second,
        lifted,
        skeleton,
        sensed=sensed,
        around=around,
        sigma_focal=sigma_focal,
    )


def _is_calibrated(camera: Camera) -> bool:
    return camera.uncertainty is None and not camera.assumed


def _apart(first: Camera, second: Camera) -> str:
    metres = float(np.linalg.norm(second.center_world - first.center_world))
    cosine = float(np.clip(first.R_camera_world[2] @ second.R_camera_world[2], -1.0, 1.0))
    return f"{metres:.1f} m from the first one, looking {np.degrees(np.arccos(cosine)):.0f} degrees apart"


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
