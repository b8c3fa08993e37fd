"""A short recording with planted errors, and everything open that can be."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import planted
from numpy.typing import NDArray

from rtof_kin.body.skeleton import Motion, SkeletonModel
from rtof_kin.calibration.estimate import calibrate, shared_fragments
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.calibration.shared_fragments import SharedFragments, Slice
from rtof_kin.core import rotations as so3
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.initial_guess import InitialGuess, initial_guess
from rtof_kin.solve.settings import JointSpaceSettings

Array = NDArray[np.float64]
BODY = SkeletonModel.default()
FRAMES = 12
SETTINGS = JointSpaceSettings(floor_height=0.0, sigma_floor=0.03)
OPEN = {
    "delay": {"sigma_delay": 0.05},
    "heading": {"sigma_heading": 0.1},
    "mounting": {"sigma_swing": 0.05, "sigma_twist": 0.1},
    "bones": {"sigma_size": 0.05, "sigma_proportion": 0.03},
    "image bias": {"sigma_image_bias": 6.0},
    "place": {"sigma_place": 0.02, "sigma_swing": 0.05},
    "ankle height": {"sigma_ankle_height": 0.03},
}
"""Kind -> what leaves it open."""
NOTHING = {name: None for name in vars(CalibrationPriors()) if name.startswith("sigma_")} | {"sigma_twist": 0.1}


def only(*kinds: str, **more: float) -> CalibrationPriors:
    """Priors that leave nothing else open."""
    chosen = {name: value for kind in kinds for name, value in OPEN[kind].items()}
    return CalibrationPriors(**(NOTHING | chosen | more))


def motion(frames: int, seed: int = 0) -> Motion:
    """Somebody who moves as people do, and walks about a little."""
    return planted.human(BODY, frames, seed)


def fragments(recording: Recording, start: PoseSequence, priors: CalibrationPriors) -> SharedFragments:
    """Fragments of so few frames that a test is quick."""
    return shared_fragments([whole(recording, start)], priors, SETTINGS, FRAMES)


def whole(recording: Recording, start: PoseSequence) -> Slice:
    """A recording as one slice, from poses."""
    bone_imus = recording.bone_imus(times=start.times)
    if bone_imus is None:  # to be refused
        nothing = np.zeros((len(start), 0, 3))
        bone_imus = BoneImuSequence(start.times, np.zeros((len(start), 0, 3, 3)), nothing, nothing[0], ())
    return Slice(recording, guessed(recording, start), bone_imus)


def guessed(recording: Recording, start: PoseSequence) -> InitialGuess:
    """The initial guess that a reconstruction makes of poses."""
    return initial_guess(start, recording.video, recording.bone_imus(times=start.times), recording.skeleton)


def calibrated(recording: Recording, start: PoseSequence, *given: Any, **settings: Any) -> SelfCalibration:
    """`calibrate` from poses."""
    return calibrate([whole(recording, start)], *given, **settings)


def misaligned(recording: Recording, **wrong: Array) -> Recording:
    """A recording whose calibration is wrong by headings (S,) and mountings (S, 3): what a perfect
    calibration finds."""
    given = recording.calibration
    assert given is not None
    S = len(given.sensors)
    heading = so3.about_axis("z", -wrong.get("heading", np.zeros(S)))
    mounting = so3.exp(-wrong.get("mounting", np.zeros((S, 3))))
    return replace(
        recording,
        calibration=replace(
            given, R_world_inertial=heading @ given.R_world_inertial, R_sensor_bone=given.R_sensor_bone @ mounting
        ),
    )


def late(recording: Recording, seconds: float) -> Recording:
    """A recording whose video is late."""
    seen = recording.keypoints
    return replace(recording, keypoints=replace(seen, times=seen.times + seconds))


def biased(recording: Recording, bias_px: Array) -> Recording:
    """A recording whose detector sees every landmark (L, 2) px beside where it is."""
    seen = recording.keypoints
    return replace(recording, keypoints=replace(seen, uv_px=seen.uv_px + bias_px))
