"""Checks of a recording's sensors and clocks against physics, the image and the reconstructed motion.

Checks run in the order of cause: form of the samples, then the video's rate and the clocks, then what all
sensors share, then single sensors. A check that an earlier failure would mislead is skipped.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.assignment import AssignmentCheck, check_assignment
from rtof_kin.calibration.bone_images import NAME as CLOCKS
from rtof_kin.calibration.bone_images import BoneImages, best_exchange, bone_images, check_clocks
from rtof_kin.core.checks import Check
from rtof_kin.core.errors import InvalidInputError
from rtof_kin.data.imu import BoneImuSequence, ImuCalibration, ImuSequence
from rtof_kin.data.imu_stream import SensorLog
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.outlier_rejection import FROZEN, UNEXPLAINED, check_form
from rtof_kin.inertial.pose_calibration import pose_rotations, usual_lever
from rtof_kin.inertial.setup_diagnosis import LEAST_RATIO, Fault, FaultKind, diagnose_setup, setup_log_likelihood
from rtof_kin.reconstruction.checks.causes import check_frame_rate, check_still, check_tilt, check_turned, check_twist
from rtof_kin.reconstruction.lift import LifterLike, lift
from rtof_kin.reconstruction.prepare import Job, Prepared, evenly_spaced
from rtof_kin.recording.recording import Recording

SETUP = "evidence for another setup"
_SURE, _SURE_OF_ONE = 25.0, 40.0
"""Log-likelihood ratios [nats] from which a fault is reported: of several sensors, and of a single one,
which unusual movement resembles."""
_OF_ALL, _OF_ONE = (FaultKind.FACING,), (FaultKind.SEGMENT, FaultKind.MOUNTING)
"""Faults of all sensors together, reported from `LEAST_RATIO`, and of a single one."""
_THINNED = 0.05  # [s] between the samples in which exchanged sensors are looked for
_LEAST_SECONDS = 2.0  # [s] of movement by which placement and references of sensors can be checked, at least
_ELSEWHERE = (FaultKind.SIDES, FaultKind.NEIGHBOURS, FaultKind.SWAPPED, FaultKind.SEGMENT)
"""Faults whose evidence differs where the sensors were calibrated in an N-pose."""
_DISAGREES, _EXCHANGED = 2.8, 0.7
"""Nats a frame by which a sensor contradicts the image, and by which an exchange of two reduces that, from
which the setup is diagnosed: one correct recording in twenty reaches one of them."""
_CONTRADICTED = 10.0  # [nats] by which calibrated motion may favour the map as declared


def check_sensor_form(recording: Recording) -> tuple[Check, ...]:
    """Check by physics that the samples have the units, signs and frames of a recording; nothing without IMUs."""
    imus, calibration = recording.imus, recording.calibration
    if imus is None or calibration is None or not set(imus.names) <= set(calibration.sensors):
        return ()
    return check_form(imus, calibration.select(imus.names).R_world_inertial)


def check_sensor_evidence(
    recording: Recording,
    prepared: Prepared,
    poses: PoseSequence,
    lifter: LifterLike | None,
    suspect: bool = False,
    view_suspect: bool = False,
) -> tuple[Check, ...]:
    """Check the declared sensors and clocks.

    Args:
        prepared: the prepared streams and the poses of each stage before the solver.
        lifter: as for `reconstruct`. suspect: another finding may be explained by a wrong sensor setup.
        view_suspect: a check of the camera failed; a rotated or mirrored image makes all sensors seem rotated
            together.

    Returns:
        Every check that the recording allows; failed ones name a likely cause.
    """
    found = check_sensor_form(recording)
    if not found or recording.imus is None or recording.calibration is None:
        return found
    skeleton, lifted, video = prepared.skeleton, prepared.stages["lift"], prepared.recording.video

    def unknown_setup(why: str) -> Check:
        return Check.unknown(SETUP, "sensors", "nats", why)

    native = recording.calibration.apply(recording.imus)
    tilt = check_tilt(native, lifted)
    if tilt.failed and not any(check.failed and check.name == FROZEN for check in found):
        found = (tilt, *(check for check in found if not check.cause.startswith(UNEXPLAINED)))
    if wrong := next((check for check in found if check.failed), None):
        why = f"the samples are not as declared: {wrong.cause}"
        return (*found, Check.unknown(CLOCKS, "video and sensors", "s", why), unknown_setup(why))
    declared = recording.video
    seen = replace(video, times=np.interp(video.video_times, declared.video_times, declared.times))
    images = bone_images(seen, native, lifted, skeleton)
    if images is not None:
        found = (*found, check_frame_rate(images, seen))
        if found[-1].failed:
            return (*found, unknown_setup(f"first {found[-1].cause}"))
    clocks = check_clocks(seen, native, lifted, skeleton)
    if clocks.failed:
        return (*found, clocks, unknown_setup(f"first {clocks.cause}"))
    shared = [check_still(native, skeleton), tilt]
    if not view_suspect:  # of all sensors against the image, and of one about its bone
        if images is not None and not any(check.failed for check in shared):
            shared += check_turned(images, declared.camera, tilt.passed)
        if prepared.bone_imus is not None:
            shared.append(check_twist(poses, prepared.bone_imus, skeleton))
    found = (*found, *shared)
    if wrong := next((check for check in shared if check.failed), None):
        return (*found, clocks, unknown_setup(f"first {wrong.cause}"))
    return (*found, clocks, _check_setup(recording, prepared, seen, images, native, lifter, suspect, view_suspect))


def _exchanged_samples(imus: ImuSequence, calibration: ImuCalibration) -> Iterator[BoneImuSequence]:
    """Yield the samples with their calibrations exchanged, for `best_exchange`."""
    step = float(np.median(np.diff(imus.times))) if len(imus) > 1 else _THINNED
    thin = imus[:: max(1, int(_THINNED / step))]
    for names in _rolled(imus.names):
        yield calibration.apply(replace(thin, names=names))


def _rolled(names: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    for shift in range(len(names)):
        yield names[shift:] + names[:shift]


def _check_setup(
    recording: Recording,
    prepared: Prepared,
    seen: KeypointSequence,
    images: BoneImages | None,
    native: BoneImuSequence,
    lifter: LifterLike | None,
    suspect: bool,
    view_suspect: bool,
) -> Check:
    """Diagnose placement and world frame of the sensors from movement and a lift without sensors, where image and
    sensors disagree, or agree better with two of them exchanged.
    """
    imus, calibration, skeleton = recording.imus, recording.calibration, prepared.skeleton
    assert imus is not None
    assert calibration is not None
    off = np.full(1, np.nan) if images is None else images.by_sensor()
    if np.isnan(off).all() and not suspect:
        return Check.unknown(SETUP, "sensors", "nats", "no bone with a sensor is visible in the image")
    segments = (replace(native, joints=joints) for joints in _rolled(native.joints))
    if not (suspect or np.nanmax(off, initial=0.0) > _DISAGREES) and all(
        best_exchange(seen, reading, prepared.stages["lift"], skeleton) <= _EXCHANGED
        for reading in (segments, _exchanged_samples(imus, calibration))
    ):
        return Check(SETUP, "sensors", 0.0, _SURE, "nats")
    if prepared.bone_imus is not None or prepared.calibration is not None:
        prepared = Job.of(recording, skeleton, lifter, prepared.settings, None).prepare("lift")
    bone_imus, visual = prepared.recording.bone_imus(), prepared.stages["lift"]
    times = np.zeros(0)
    if bone_imus is not None:
        known = np.asarray(np.isfinite(bone_imus.R_world_bone).all(axis=(-2, -1)))
        times = bone_imus.times[known.any(axis=1)]
    if bone_imus is None or not len(times) or np.ptp(times) < _LEAST_SECONDS:
        why = f"video and sensors have less than {_LEAST_SECONDS:g} s in common"
        return Check.unknown(SETUP, "sensors", "nats", why)
    found = [
        fault
        for pose, kinds in (("T", tuple(FaultKind)), ("N", _ELSEWHERE))
        for fault in diagnose_setup(
            bone_imus, skeleton, pose=pose, visual=visual, calibration=calibration, kinds=kinds, most=1
        )
    ]
    if not found:
        return Check(SETUP, "sensors", 0.0, _SURE, "nats")

    def least(fault: Fault) -> float:
        return LEAST_RATIO if fault.kind in _OF_ALL else _SURE_OF_ONE if fault.kind in _OF_ONE else _SURE

    fault = max(found, key=lambda fault: fault.log_likelihood_ratio / least(fault))
    if view_suspect and fault.kind in _OF_ALL:
        return Check.unknown(SETUP, "sensors", "nats", "all sensors seem rotated, which the camera may explain")
    advice = f"{fault.remedy}. Or else: {'; '.join(fault.alternatives)}" if fault.alternatives else fault.remedy
    return Check(SETUP, "sensors", fault.log_likelihood_ratio, least(fault), "nats", advice, cause=fault.what)


def check_recording(recording: Recording) -> tuple[AssignmentCheck, Recording]:
    """Check which segments the sensors of a recording are on, with its video if it has one whose clock agrees.

    How the calibration has to change is chosen by the likelihood of the calibrated motion: the sensors were calibrated
    on the wrong segments, in a T-pose or an N-pose, or their samples are filed under each other's names.
    `InvalidInputError`: no IMUs or calibration, or too little of them; `ViewError`: a lifted pose is behind the camera.

    Returns:
        The check, and the recording with the correction, or as it is where nothing is wrong.
    """
    imus, calibration = recording.imus, recording.calibration
    if imus is None or calibration is None:
        raise InvalidInputError(f"{recording.name} has no calibrated sensors whose places could be checked")
    calibration, skeleton = calibration.select(imus.names), recording.skeleton
    joints = dict(zip(calibration.sensors, calibration.joints, strict=True))
    poses = None if recording.keypoints is None else lift(evenly_spaced(recording.video), skeleton).poses
    if poses is not None and check_clocks(recording.video, calibration.apply(imus), poses, skeleton).failed:
        poses = None
    check = check_assignment(SensorLog.of_imus(imus, recording.name), joints, skeleton, poses)
    if not check.wrong:
        return check, recording
    declared, *scores = (
        (setup_log_likelihood(way.apply(imus), skeleton, poses), way)
        for way in (calibration, *_corrections(calibration, check.joints, skeleton))
    )
    best, way = max(scores, key=lambda pair: pair[0])
    if best < declared[0] - _CONTRADICTED:
        doubt = f"{'; '.join(map(str, check.wrong))}; but the calibration agrees with the declared places"
        return replace(check, joints=joints, wrong=(), doubt=doubt), recording
    return check, replace(recording, calibration=way)


def _corrections(
    calibration: ImuCalibration, joints: Mapping[str, str], skeleton: SkeletonModel
) -> Iterator[ImuCalibration]:
    """Yield calibrations with the sensors on other segments."""
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
