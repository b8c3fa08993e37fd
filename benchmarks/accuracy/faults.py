"""What may be wrong with a recording, one thing at a time; the truth stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from rtof_kin import rotations as so3
from rtof_kin.recording import Recording

Array = NDArray[np.float64]
NOMINAL = "nominal"
LEFT_LIMBS = ("LeftArm", "LeftForeArm", "LeftHand", "LeftUpLeg", "LeftLeg", "LeftFoot")
LIMBS = (*LEFT_LIMBS, *(name.replace("Left", "Right") for name in LEFT_LIMBS))
MIDDLE_SECOND, SECOND_AFTER_HALF = (-0.5, 0.5), (0.0, 1.0)
"""Windows, s after the middle of a video."""


def bounds(times: Array, window: tuple[float, float]) -> tuple[float, float]:
    """Beginning and end of a window in a video with these times, s."""
    middle = float(times[0] + times[-1]) / 2
    return middle + window[0], middle + window[1]


def _with_keypoints(recording: Recording, **changes: Any) -> Recording:
    return replace(recording, keypoints=replace(recording.keypoints, **changes))


def with_outliers(recording: Recording, rng: Generator) -> Recording:
    """A tenth of all landmarks, drawn one by one, displaced by 80 px in any direction."""
    keypoints = recording.keypoints
    hit = rng.random(keypoints.confidence.shape) < 0.1
    angle = rng.uniform(0, 2 * np.pi, hit.shape)
    shift = 80.0 * np.stack([np.cos(angle), np.sin(angle)], axis=-1) * hit[..., None]
    return _with_keypoints(recording, uv_px=keypoints.uv_px + shift)


def with_unseen_limbs(recording: Recording, rng: Generator) -> Recording:
    """The left arm and leg unseen for the middle second."""
    keypoints = recording.keypoints
    start, stop = bounds(keypoints.times, MIDDLE_SECOND)
    during = (keypoints.times >= start) & (keypoints.times < stop)
    hidden = during[:, None] & np.isin(keypoints.names, LEFT_LIMBS)
    return _with_keypoints(
        recording,
        uv_px=np.where(hidden[..., None], np.nan, keypoints.uv_px),
        confidence=np.where(hidden, 0.0, keypoints.confidence),
    )


def without_sensor(recording: Recording, rng: Generator) -> Recording:
    """The left forearm's sensor missing altogether."""
    imus = recording.imus
    assert imus is not None
    return replace(recording, imus=imus.select([name for name in imus.names if name != "L_LowArm"]))


def with_stopped_sensors(
    recording: Recording, rng: Generator, names: tuple[str, ...] | None = None
) -> Recording:
    """Some sensors, or all, that say nothing after half of the video."""
    imus = recording.imus
    assert imus is not None
    stop, _ = bounds(recording.keypoints.times, SECOND_AFTER_HALF)
    stopped = np.isin(imus.names, imus.names if names is None else names)
    gone = (imus.times >= stop)[:, None] & stopped
    return replace(
        recording,
        imus=replace(
            imus,
            R_inertial_sensor=np.where(gone[..., None, None], np.nan, imus.R_inertial_sensor),
            f_sensor=np.where(gone[..., None], np.nan, imus.f_sensor),
        ),
    )


def with_randomly_wrong_bones(recording: Recording, rng: Generator) -> Recording:
    """Each bone believed too long or too short by a random share, 3 % standard deviation."""
    factor = 1 + 0.03 * rng.standard_normal((len(recording.joint_offsets), 1))
    return replace(recording, joint_offsets=recording.joint_offsets * factor)


def with_long_bones(recording: Recording, rng: Generator) -> Recording:
    """All bones believed 3 % too long."""
    return replace(recording, joint_offsets=recording.joint_offsets * 1.03)


def with_wrong_focal_length(recording: Recording, rng: Generator) -> Recording:
    """A focal length believed 2 % too long."""
    camera = recording.keypoints.camera
    K = camera.K * np.array([[1.02], [1.02], [1.0]])
    K[:, 2] = camera.K[:, 2]
    return _with_keypoints(recording, camera=replace(camera, K=K))


def with_tilted_camera(recording: Recording, rng: Generator) -> Recording:
    """A camera that is believed to look 1 deg lower or higher, from the place where it is."""
    camera = recording.keypoints.camera
    R = so3.about_axis("x", np.radians(1.0)) @ camera.R_camera_world
    tilted = replace(camera, R_camera_world=R, t_camera_world=-R @ camera.center_world)
    return _with_keypoints(recording, camera=tilted)


def with_late_video(recording: Recording, rng: Generator, delay: float) -> Recording:
    """A video that shows what was `delay` s before its time stamps, in whole frames.

    Truth and sensors keep their clock; frames that would show what was before the start are left out.
    """
    keypoints = recording.keypoints
    late = round(delay / float(np.median(np.diff(keypoints.times))))
    shown = keypoints[: len(keypoints) - late]
    return replace(recording, keypoints=replace(shown, times=keypoints.times[late:]))


def with_wrong_heading(recording: Recording, rng: Generator) -> Recording:
    """All sensors' references believed turned by 10 deg about the vertical, all alike."""
    own = recording.calibration
    assert own is not None
    R = so3.about_axis("z", np.radians(10.0)) @ own.R_world_inertial
    return replace(recording, calibration=replace(own, R_world_inertial=R))


def with_wrong_mounting(recording: Recording, rng: Generator) -> Recording:
    """Each sensor believed mounted as it is not, by random 6 deg about each axis."""
    own = recording.calibration
    assert own is not None
    turn = so3.exp(np.radians(6.0) * rng.standard_normal((len(own.sensors), 3)))
    return replace(recording, calibration=replace(own, R_sensor_bone=own.R_sensor_bone @ turn))


@dataclass(frozen=True)
class Fault:
    """Something wrong, and where in time it is looked at."""

    apply: Callable[[Recording, Generator], Recording]
    """Another recording with the same truth; equal draws give equal faults."""
    window: tuple[float, float] | None = None
    """s after the middle of the video, before, in and after which errors are told; None for none."""
    joints: tuple[str, ...] = ()
    """Whose error is told there besides that of all joints."""


FAULTS = {
    NOMINAL: Fault(lambda recording, rng: recording),
    "10 % outliers of 80 px": Fault(with_outliers),
    "left arm and leg unseen for 1 s": Fault(with_unseen_limbs, MIDDLE_SECOND, LEFT_LIMBS),
    "left forearm's sensor missing": Fault(without_sensor),
    "left forearm's sensor stops halfway": Fault(
        partial(with_stopped_sensors, names=("L_LowArm",)), SECOND_AFTER_HALF,
        ("LeftForeArm", "LeftHand"),
    ),
    "all sensors stop halfway": Fault(with_stopped_sensors, SECOND_AFTER_HALF, LIMBS),
    "bones wrong by 3 % at random": Fault(with_randomly_wrong_bones),
    "all bones 3 % too long": Fault(with_long_bones),
    "focal length + 2 %": Fault(with_wrong_focal_length),
    "camera tilted by 1 deg": Fault(with_tilted_camera),
    "video late by 33 ms": Fault(partial(with_late_video, delay=1 / 30)),
    "video late by 100 ms": Fault(partial(with_late_video, delay=0.1)),
    "headings off by 10 deg": Fault(with_wrong_heading),
    "mounting off by 6 deg per axis": Fault(with_wrong_mounting),
}  # fmt: skip
