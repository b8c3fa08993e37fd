"""Check of a declared map from sensors to segments, and its correction.

Whether another assignment explains the motion better is asked without the calibration (`assignment`), so that
neither a wrong mounting nor a wrong heading matters. How the calibration has to change is then chosen by the
likelihood of the calibrated motion (`inertial.setup_diagnosis`): the sensors were calibrated on the wrong
segments, in a T-pose or an N-pose, or their samples are filed under each other's names.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.clock_check import check_clocks
from rtof_kin.core.array_types import Array
from rtof_kin.core.checks import Check, indices_of
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import ImuCalibration
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.pose_calibration import usual_lever
from rtof_kin.inertial.poses import pose_rotations
from rtof_kin.inertial.setup_diagnosis import setup_log_likelihood
from rtof_kin.reconstruction.lift import lift
from rtof_kin.reconstruction.prepare import evenly_spaced
from rtof_kin.recording.recording import Recording
from rtof_kin.setup.assignment import match_sensors, usual_segments
from rtof_kin.setup.matching import Labels
from rtof_kin.setup.sensor_motion import sensor_motions

NAME = "another place of sensors"
_FIRST_ERROR, _FURTHER_ERROR = 6.0, 0.5  # [nats] against a map with errors, and for each sensor concerned
_SURE = 0.9  # [-] probability from which a sensor is said to be elsewhere
_CONTRADICTED = 10.0  # [nats] by which calibrated motion may favour the map as declared


@dataclass(frozen=True)
class WrongSensor:
    """A sensor that is not where it is declared."""

    sensor: str
    declared: str
    """Segment it is declared on."""
    likely: str
    """Segment it is on."""
    probability: float
    """Of that."""

    def __str__(self) -> str:
        where = f"declared on {self.declared}, is on {self.likely}"
        return f"{self.sensor}, {where} ({100 * self.probability:.0f} %)"


@dataclass(frozen=True)
class AssignmentCheck:
    """What motion tells of a map from sensors to segments."""

    joints: dict[str, str]
    """Sensor -> segment, corrected where that is sure."""
    wrong: tuple[WrongSensor, ...]
    """Sensors that are elsewhere."""
    probability: float
    """That the map as declared is wrong somewhere."""
    doubt: str = ""
    """What is possible but not sure, in one sentence; may be empty."""

    def check(self) -> Check:
        """Return the result as a check of plausibility."""
        advice = "; ".join(map(str, self.wrong)) + ". Write the corrected recording with --fix -o OUT"
        cause = "sensors are not where they are declared" if self.wrong else ""
        value = self.probability if self.wrong else min(self.probability, 1 - _SURE)
        return Check(NAME, "sensors", value, 1 - _SURE, "", advice if self.wrong else self.doubt, cause=cause)


def check_assignment(
    log: SensorLog, joints: Mapping[str, str], skeleton: SkeletonModel, poses: PoseSequence | None = None
) -> AssignmentCheck:
    """Check that sensors are where they are declared. A map without errors is taken to be likelier.

    Args:
        log: the sensors; with poses, on their clock. joints: sensor -> segment, by its proximal joint;
            others are ignored. skeleton: the subject's. poses: lifted from a video, if there is one.

    Raises:
        UnknownNameError: a sensor or segment does not exist.
        InvalidInputError: two sensors on one segment, too little data, or no evidence without poses.
    """
    indices_of("sensor", list(joints), log.names)
    indices_of("segment", list(joints.values()), skeleton.names)
    if len(set(joints.values())) < len(joints):
        twice = sorted({j for j in joints.values() if list(joints.values()).count(j) > 1})
        raise InvalidInputError(f"there are two sensors on {', '.join(twice)}; declare each where it is")
    motions = sensor_motions(log.select(list(joints)))
    segments = tuple(dict.fromkeys([*usual_segments(skeleton), *joints.values()]))
    declared = np.array([segments.index(joints[name]) for name in motions.names])

    def prior(labels: Labels) -> Array:
        errors = np.sum(labels != declared, axis=1)
        return np.asarray(-np.where(errors > 0, _FIRST_ERROR + _FURTHER_ERROR * errors, 0.0))

    found = match_sensors(motions, skeleton, segments, poses, prior=prior)
    wrong, unsure, corrected = [], [], dict(joints)
    for name, own, k, row in zip(motions.names, declared, found.best, found.probability, strict=True):
        if k != own and row[k] >= _SURE:
            wrong.append(WrongSensor(name, segments[own], segments[k], float(min(row[k], 0.999))))
            corrected[name] = segments[k]
        elif row[own] < _SURE:
            other = max((i for i in range(len(segments)) if i != own), key=lambda i: float(row[i]))
            unsure.append(f"{name} may be on {segments[other]} ({100 * row[other]:.0f} %)")
    if len(set(corrected.values())) < len(corrected):  # a part of an exchange alone is no correction
        unsure += [f"{sensor.sensor} may be on {sensor.likely}" for sensor in wrong]
        wrong, corrected = [], dict(joints)
    probability = 1 - float(np.prod(found.probability[np.arange(len(declared)), declared]))
    doubt = f"by its motion {', '.join(unsure)}; what is declared is kept" if unsure else ""
    return AssignmentCheck(corrected, tuple(wrong), probability, doubt)


def check_recording(recording: Recording) -> tuple[AssignmentCheck, Recording]:
    """Check the sensors of a recording with its video, if it has one whose clock agrees.

    Returns:
        The check, and the recording with the correction, or as it is where nothing is wrong.

    Raises:
        InvalidInputError: no IMUs or calibration, or too little of them.
        ViewError: a lifted pose is behind the camera.
    """
    imus, calibration = recording.imus, recording.calibration
    if imus is None or calibration is None:
        raise InvalidInputError(f"{recording.name} has no calibrated sensors whose places could be checked")
    calibration = calibration.select(imus.names)
    joints = dict(zip(calibration.sensors, calibration.joints, strict=True))
    skeleton = recording.skeleton
    poses = None if recording.keypoints is None else lift(evenly_spaced(recording.video), skeleton).poses
    if poses is not None:
        clocks = check_clocks(recording.video, calibration.apply(imus), poses, skeleton)
        poses = None if clocks.failed else poses
    check = check_assignment(SensorLog.of_imus(imus, recording.name), joints, skeleton, poses)
    if not check.wrong:
        return check, recording
    scores = [
        (setup_log_likelihood(way.apply(imus), skeleton, poses), way)
        for way in (calibration, *_corrections(calibration, check.joints, skeleton))
    ]
    best, way = max(scores[1:], key=lambda pair: pair[0])
    if best < scores[0][0] - _CONTRADICTED:
        doubt = f"{'; '.join(map(str, check.wrong))}; but the calibration agrees with the declared places"
        return replace(check, joints=joints, wrong=(), doubt=doubt), recording
    return check, replace(recording, calibration=way)


def _corrections(
    calibration: ImuCalibration, joints: Mapping[str, str], skeleton: SkeletonModel
) -> Iterator[ImuCalibration]:
    """Generate calibrations with the sensors on other segments."""
    new = tuple(joints[sensor] for sensor in calibration.sensors)
    known = dict(zip(calibration.joints, calibration.p_bone_sensor, strict=True))
    levers = np.stack([known.get(j, usual_lever(j, skeleton)) for j in new])
    before, after = list(skeleton.index(*calibration.joints)), list(skeleton.index(*new))
    for pose in ("T", "N"):
        R = pose_rotations(pose, skeleton)
        turned = calibration.R_sensor_bone @ np.swapaxes(R[before], -1, -2) @ R[after]
        yield replace(calibration, joints=new, R_sensor_bone=turned, p_bone_sensor=levers)
    if set(new) == set(calibration.joints):  # the samples are filed under each other's names
        order = [calibration.joints.index(joint) for joint in new]
        others = calibration.select(tuple(calibration.sensors[i] for i in order))
        yield replace(others, sensors=calibration.sensors)
