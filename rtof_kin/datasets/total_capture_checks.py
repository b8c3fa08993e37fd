"""Checks of a Total Capture take that need no estimate: does what its files say fit together?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rtof_kin import rotations as so3
from rtof_kin import signals
from rtof_kin.datasets.total_capture import MISCALIBRATED, Take
from rtof_kin.datasets.total_capture_truth import RIGID_MM
from rtof_kin.types import BoneImuSequence, KeypointSequence

Array = NDArray[np.float64]
T_POSE_DEG = 35.0
"""A bone this far off its direction in the T-pose is in no T-pose; subjects stand up to 20 off."""
FACING_DEG = 45.0
ACCELERATION = 0.5
"""Largest mean of acceleration less gravity over a take, m/s^2."""
IMU_DEG = 15.0
"""Largest median angle between a sensor's segment and the reference's."""
REPROJECTION_PX = 20.0
_T_POSE_BONES = ("RightForeArm", "RightHand", "LeftForeArm", "LeftHand",
                 "RightLeg", "RightFoot", "LeftLeg", "LeftFoot")  # fmt: skip
"""Child joints of the limb bones that make a T-pose."""


@dataclass(frozen=True)
class Check:
    """One figure against its limit."""

    name: str
    """What is checked."""
    subject: str
    """What it is about: the take, a sensor, a camera."""
    value: float
    limit: float
    unit: str
    """Of value and limit."""
    advice: str
    """What a failure may mean."""

    @property
    def passed(self) -> bool:
        """Whether the figure is known and within its limit."""
        return bool(self.value <= self.limit)

    @property
    def message(self) -> str:
        """One line: what, where, the figure, its limit, and what a failure may mean."""
        text = f"{self.subject}: {self.name} is {self.value:.3g} {self.unit}"
        text += f" (limit {self.limit:g})"
        return text if self.passed else f"{text}. {self.advice}"


def check_take(take: Take) -> list[Check]:
    """T-pose and facing at frame 0, a rigid skeleton, and every sensor against the reference."""
    checks = list(_check_start(take))
    if np.isfinite(take.spread_mm):
        advice = "Positions and orientations do not belong together"
        checks.append(
            Check("spread of bone lengths", "take", take.spread_mm, RIGID_MM, "mm", advice)
        )
    if take.imus is not None and take.calibration is not None:
        bone_imus = take.calibration.apply(take.imus)
        for sensor, name in enumerate(take.imus.names):
            checks += _check_sensor(take, bone_imus, sensor, f"sensor {name}")
    return checks


def check_keypoints(take: Take, camera: int, keypoints: KeypointSequence) -> list[Check]:
    """How far a detector's landmarks lie from the reference's joints in the picture."""
    names = [name for name in keypoints.names if name in take.truth.names]
    count = min(len(take.truth), len(keypoints))
    index = [take.truth.names.index(name) for name in names]
    true = take.cameras[camera].project(take.truth.p_world_joint[:count, index])
    error = np.linalg.norm(keypoints.select(names).uv_px[:count] - true, axis=-1)
    advice = "Detections of another take, person or camera, or landmarks far from the joints"
    if camera in MISCALIBRATED:
        advice = MISCALIBRATED[camera][0].upper() + MISCALIBRATED[camera][1:]
    value = _median(error)
    return [Check("median reprojection", f"camera {camera}", value, REPROJECTION_PX, "px", advice)]


def _check_start(take: Take) -> Iterator[Check]:
    """The first frame: a T-pose that faces +y of the z-up world (-Z of the dataset's)."""
    skeleton, p = take.skeleton, take.truth.p_world_joint[0]
    right = p[skeleton.index("RightUpLeg")[0]] - p[skeleton.index("LeftUpLeg")[0]]
    turned = float(np.degrees(np.arctan2(right[1], right[0])))
    advice = "Is the take cut, or in another world frame?"
    yield Check(
        "turn away from the usual facing at frame 0", "take", abs(turned), FACING_DEG, "deg", advice
    )
    R_world_t_pose = so3.about_axis("z", np.radians(turned + 90.0))
    worst = 0.0
    for child in skeleton.index(*_T_POSE_BONES):
        bone = p[child] - p[skeleton.parents[child]]
        expected = R_world_t_pose @ skeleton.joint_offsets[child]
        angle = np.arctan2(np.linalg.norm(np.cross(bone, expected)), bone @ expected)
        worst = max(worst, float(np.degrees(angle)))
    advice = "Takes begin in a T-pose: is this one cut?"
    yield Check(
        "largest angle of a limb from the T-pose at frame 0",
        "take",
        worst,
        T_POSE_DEG,
        "deg",
        advice,
    )


def _check_sensor(take: Take, imus: BoneImuSequence, sensor: int, subject: str) -> Iterator[Check]:
    truth = take.truth
    count = min(len(truth), len(imus))
    joint = truth.names.index(imus.joints[sensor])
    angle = so3.angle_between(imus.R_world_bone[:count, sensor], truth.R_world_bone[:count, joint])
    if truth.orientation_observed[0, joint]:
        advice = "The calibration of another take, quaternions in another order, or a sensor that slipped"
        value = float(np.degrees(_median(angle)))
        yield Check(
            "median angle to the reference's segment", subject, value, IMU_DEG, "deg", advice
        )
    a = np.full((count, 3), np.nan)
    a[1:-1] = signals.derivative(truth.p_world_joint[:count, joint], truth.rate_hz, 2)
    difference = imus.a_world[:count, sensor] - a
    known = difference[np.asarray(np.isfinite(difference).all(axis=-1))]
    mean = float(np.linalg.norm(known.mean(axis=0))) if len(known) else float("nan")
    name = "mean acceleration less gravity and the joint's own"
    advice = "Is gravity in the data, in m/s2, and the calibration this take's?"
    yield Check(name, subject, mean, ACCELERATION, "m/s2", advice)


def _median(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else float("nan")
