"""Consistency checks of the files of a Total Capture take, without a reconstruction."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from rtof_kin.core import rotations as so3
from rtof_kin.core import signals
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.datasets.total_capture import Take
from rtof_kin.datasets.total_capture_files import MISCALIBRATED
from rtof_kin.datasets.total_capture_truth import RATE_HZ, RIGID_MM

_T_POSE_DEG: Final = 25.0
"""Largest angle of a limb from the T-pose, deg; subjects are up to 20 deg off."""
_FACING_DEG: Final = 45.0
_HEIGHT, _HEIGHT_RANGE = 1.7, 0.5
"""Standing height of an adult and its largest deviation, m."""
_ACCELERATION: Final = 0.5
"""Largest mean over a take of acceleration minus gravity and the reference's, m/s^2."""
_IMU_DEG: Final = 15.0
"""Largest median angle between a sensor's segment and the reference's, deg."""
_REPROJECTION_PX: Final = 20.0
_BIAS_PX: Final = {2: float(np.hypot(20, -8))}
"""Known error of detections on a miscalibrated camera's video, px."""
_T_POSE_BONES = ("RightForeArm", "RightHand", "LeftForeArm", "LeftHand", "RightLeg", "RightFoot", "LeftLeg", "LeftFoot")
"""Child joints of the limb bones that make a T-pose."""


def check_take(take: Take) -> list[Check]:
    """Check the T-pose and facing at frame 0, the body's size, rigidity, and every sensor."""
    checks = [*_check_start(take), _check_size(take), _check_bones(take)]
    if take.imus is not None and take.calibration is not None:
        bone_imus = take.calibration.apply(take.imus)
        checks += _check_orientations(take, bone_imus, take.imus.names)
        checks += _check_accelerations(take, bone_imus, take.imus.names)
    return checks


def check_camera(camera: int) -> list[Check]:
    """Return a failed check for a camera that is known to be miscalibrated, none for others.

    Args:
        camera: number, 1 to 8.
    """
    if camera not in MISCALIBRATED:
        return []
    advice = f"{_sentence(MISCALIBRATED[camera])}; ground-truth 2D is not affected"
    return [
        Check("known bias of the calibration", f"camera {camera}", _BIAS_PX[camera], _REPROJECTION_PX, "px", advice)
    ]


def check_keypoints(take: Take, camera: int, keypoints: KeypointSequence) -> list[Check]:
    """Check the median reprojection error of the reference's joints.

    Args:
        camera: number, 1 to 8.

    Raises:
        UnknownNameError: the take has no such camera.
    """
    seen_by = take.camera(camera)
    names = [name for name in keypoints.names if name in take.truth.names]
    count = min(len(take.truth), len(keypoints))
    index = [take.truth.names.index(name) for name in names]
    true = seen_by.project(take.truth.p_world_joint[:count, index])
    error = np.linalg.norm(keypoints.select(names).uv_px[:count] - true, axis=-1)
    advice = "Detections of another take, person or camera, or landmarks far from the joints?"
    if camera in MISCALIBRATED:
        advice = _sentence(MISCALIBRATED[camera])
    value = _median(error)
    return [Check("median reprojection", f"camera {camera}", value, _REPROJECTION_PX, "px", advice)]


def _check_start(take: Take) -> Iterator[Check]:
    """Check that frame 0 is a T-pose that faces +y of the z-up world (-Z of the dataset's)."""
    skeleton, p = take.skeleton, take.truth.p_world_joint[0]
    right = p[skeleton.index("RightUpLeg")[0]] - p[skeleton.index("LeftUpLeg")[0]]
    turned_deg = float(np.degrees(np.arctan2(right[1], right[0])))
    advice = "Is the take cut, or in another world frame?"
    yield Check("turn from the usual facing at frame 0", "take", abs(turned_deg), _FACING_DEG, "deg", advice)
    R_world_t_pose = so3.about_axis("z", np.radians(turned_deg + 90.0))
    children = skeleton.index(*_T_POSE_BONES)
    bones = p[children] - p[[skeleton.parents[child] for child in children]]
    expected = skeleton.joint_offsets[children] @ R_world_t_pose.T
    sin = np.linalg.norm(np.cross(bones, expected), axis=-1)
    angles = np.degrees(np.arctan2(sin, np.sum(bones * expected, axis=-1)))
    worst = int(np.argmax(angles))  # the first NaN, if there is one
    bone = f"{skeleton.names[skeleton.parents[children[worst]]]} to {_T_POSE_BONES[worst]}"
    name = f"largest angle of a limb from the T-pose at frame 0 ({bone})"
    advice = "Takes begin in a T-pose: is this one cut?"
    yield Check(name, "take", float(angles[worst]), _T_POSE_DEG, "deg", advice)


def _check_size(take: Take) -> Check:
    """Check the standing height, which is wrong if positions are not in inches."""
    height = take.skeleton.height
    advice = f"It stands {height:.3g} m tall: are the file's positions in inches, as the dataset's are?"
    off = abs(height - _HEIGHT)
    return Check(f"standing height from {_HEIGHT} m", "take", off, _HEIGHT_RANGE, "m", advice)


def _check_bones(take: Take) -> Check:
    """Check that the skeleton is rigid; with derived orientations, that bones have constant length."""
    if np.isfinite(take.spread_mm):
        advice = "Do positions and orientations belong together?"
        return Check("spread of joints in their parents' frames", "take", take.spread_mm, RIGID_MM, "mm", advice)
    p = take.truth.p_world_joint
    lengths = np.linalg.norm(p[:, 1:] - p[:, list(take.skeleton.parents[1:])], axis=-1)
    spread_mm = 1000 * float(np.nanstd(lengths, axis=0).max())
    return Check(
        "spread of bone lengths",
        "take",
        spread_mm,
        RIGID_MM,
        "mm",
        "The reference's bones are rigid: are the positions damaged?",
    )


def _check_orientations(take: Take, imus: BoneImuSequence, sensors: tuple[str, ...]) -> list[Check]:
    """Check the median angle between a sensor's segment and the reference's, where that is known."""
    truth = take.truth
    count = min(len(truth), len(imus))
    medians_deg: dict[str, float] = {}
    for s, (sensor, joint) in enumerate(zip(sensors, imus.joints, strict=True)):
        j = truth.names.index(joint)
        if truth.orientation_observed[:, j].any():
            angles = so3.angle_between(imus.R_world_bone[:count, s], truth.R_world_bone[:count, j])
            medians_deg[sensor] = float(np.degrees(_median(angles)))
    failed = sum(not median <= _IMU_DEG for median in medians_deg.values())
    advice = "Has the sensor slipped, or is this the calibration of another take?"
    if failed > len(medians_deg) / 2:
        share = f"{failed} of {len(medians_deg)} sensors"
        advice = f"{share} fail this: is it the calibration of another take?"
    return [
        Check("median angle to the reference's segment", f"sensor {sensor}", value, _IMU_DEG, "deg", advice)
        for sensor, value in medians_deg.items()
    ]


def _check_accelerations(take: Take, imus: BoneImuSequence, sensors: tuple[str, ...]) -> Iterator[Check]:
    """Check the mean of a sensor's acceleration minus gravity and minus the reference's at its place."""
    truth = take.truth
    count = min(len(truth), len(imus))
    j = [truth.names.index(joint) for joint in imus.joints]
    lever = np.einsum("tsij,sj->tsi", truth.R_world_bone[:count, j], imus.p_bone_sensor)
    p = truth.p_world_joint[:count, j] + lever
    a_reference = np.full(p.shape, np.nan)
    if count > 2:
        a_reference[1:-1] = signals.derivative(p, RATE_HZ, 2)
    excess = imus.a_world[:count] - a_reference
    name = "mean acceleration less gravity and the reference's"
    advice = "Is gravity in the data, in m/s^2, and is the calibration this take's?"
    for s, sensor in enumerate(sensors):
        known = excess[np.isfinite(excess[:, s]).all(axis=-1), s]
        mean = float(np.linalg.norm(known.mean(axis=0))) if len(known) else float("nan")
        yield Check(name, f"sensor {sensor}", mean, _ACCELERATION, "m/s^2", advice)


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")


def _sentence(text: str) -> str:
    return text[0].upper() + text[1:]
