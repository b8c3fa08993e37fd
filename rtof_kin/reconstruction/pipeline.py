"""`reconstruct`: a recording in, a motion out: the paper's three stages, or inertial sensors alone."""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rtof_kin.body.metrics import Metrics, stage_metrics
from rtof_kin.body.skeleton import MotionSequence, SkeletonModel
from rtof_kin.calibration.estimate import calibrate as calibrate_from
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core.choices import MODES
from rtof_kin.core.errors import CalibrationError, ShapeError, UnknownNameError
from rtof_kin.core.plausibility import Check
from rtof_kin.data.imu import BoneImuSequence
from rtof_kin.data.keypoints import KeypointSequence
from rtof_kin.data.poses import PoseSequence
from rtof_kin.data.stream_faults import FaultKind, StreamFault
from rtof_kin.inertial.outlier_rejection import disagreeing, joined, without
from rtof_kin.reconstruction.camera_checks import check_camera_evidence, explained
from rtof_kin.reconstruction.choices import Choices
from rtof_kin.reconstruction.consistency_checks import check_height, consistency_warnings
from rtof_kin.reconstruction.prepare import (
    LifterLike,
    Prepared,
    Progress,
    ReconstructionSettings,
    evenly_spaced,
    guarded,
    on_floor,
    prepare,
    sensor_places,
)
from rtof_kin.reconstruction.sensor_checks import (
    check_sensor_evidence,
    check_sensor_form,
    naming_wrong_samples,
)
from rtof_kin.reconstruction.sensors_alone import reconstruct_from_sensors
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.cartesian.settings import CartesianSettings
from rtof_kin.solve.fragment_solver import FragmentSolution, FragmentSolver
from rtof_kin.solve.joint_space.initial_guess import initial_guess
from rtof_kin.solve.joint_space.settings import JointSpaceSettings
from rtof_kin.solve.solution import misfits
from rtof_kin.solve.uncertainty.covariance_inflation import CovarianceInflation
from rtof_kin.solve.uncertainty.disagreement import disagreement
from rtof_kin.solve.uncertainty.residual_statistics import residual_statistics

__all__ = [
    "LifterLike", "Progress", "Reconstruction", "ReconstructionSettings",
    "calibrate_recording", "evenly_spaced", "reconstruct",
]  # fmt: skip
Array = NDArray[np.float64]
CAMERA_MODES = ("lift", "sf2", "rto", "rtof")
_LASTING_SHARE = 0.8
"""Of a recording, for which a sensor must differ from the others for that to be its mounting."""
DOUBTS = f"{__name__}.doubts"
"""Logger of what the audit of a result says too: failed checks, faults of streams, warnings."""


@dataclass(frozen=True)
class Reconstruction:
    """The result of `reconstruct`."""

    recording: Recording
    """As it was reconstructed: with its own calibration where it has one."""
    mode: str
    motion: MotionSequence
    """The motion of the subject's skeleton: configurations, poses, flags, and in modes rto and rtof in
    joint space how well they are known."""
    stages: dict[str, PoseSequence]
    """Poses after each stage that ran, by mode name, imu's first one being 'start'; the last is what
    `motion` was made from."""
    keypoints: KeypointSequence | None
    """The keypoints as used, evenly spaced in time; None in mode imu, which looks at none."""
    bone_imus: BoneImuSequence | None
    """The calibrated sensors at the motion's times; None in the modes that use none."""
    solution: FragmentSolution | None
    """What the fragment solver reports, in the modes that use it."""
    metrics: Metrics | None
    """Against the recording's truth; None without one."""
    stage_metrics: dict[str, Metrics]
    """The same of every stage; empty without truth."""
    root_sigma: Array | None = None
    """(T,) m, standard deviation of each horizontal coordinate of the root since the first frame, in mode
    imu, where it drifts; NaN where nothing tells of the root."""
    faults: tuple[StreamFault, ...] = ()
    """What was found wrong with keypoints and sensors, and what was done about it."""
    warnings: tuple[str, ...] = ()
    """What a user must know before relying on the motion, in sentences."""
    calibration: SelfCalibration | None = None
    """What was estimated of the recording and applied; None where it was told not to."""
    checks: tuple[Check, ...] = ()
    """What the recording declares, checked against what its streams show; failed ones name a cause."""
    choices: Choices = field(default_factory=Choices)
    """How it was made: space, backend, lifter and the like."""


def reconstruct(
    recording: Recording,
    skeleton: SkeletonModel | None = None,
    mode: str = "rtof",
    *,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    calibrate: bool | CalibrationPriors | SelfCalibration = True,
    known: SelfCalibration | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Reconstruct the motion of a recording.

    Args:
        recording: keypoints of one camera and, for sf2 and rtof, IMUs with their calibration; for imu
            these alone.
        skeleton: the subject's; from the recording where not given.
        mode: one of `MODES`.
        lifter: takes keypoints to 3D; the shipped one where not given, loaded only now.
        settings: of SF2, the fragment solver and mode imu.
        calibrate: whether the recording is calibrated from itself first (`calibrate_recording`), in the
            modes that use sensors; where it cannot be, a warning says why and it is taken as it is given.
            Or the priors to do that with, or what this recording said of itself before.
        known: what another recording of the same person said: of that, what is true of the person and
            the detector (`SelfCalibration.for_another_recording`) is taken, and no longer estimated.
        progress: told how far each stage is.

    Raises:
        UnknownNameError: no such mode. ShapeError: the mode needs keypoints or IMUs and there are none;
            the person is behind the camera. Errors of the stages pass through.
    """
    if mode not in MODES:
        raise UnknownNameError("mode", [mode], MODES)
    settings = settings or ReconstructionSettings()
    tell = progress or (lambda stage, done, total: None)
    with naming_wrong_samples(recording):
        if mode == "imu":
            return _without_camera(recording, skeleton or recording.skeleton, settings, tell)
        if recording.keypoints is None:
            raise ShapeError(f"mode {mode} needs keypoints and the recording has none; use 'imu'")
        return _with_camera(recording, skeleton, mode, lifter, settings, calibrate, known, tell)


def _with_camera(
    recording: Recording, skeleton: SkeletonModel | None, mode: str, lifter: LifterLike | None,
    settings: ReconstructionSettings, calibrate: bool | CalibrationPriors | SelfCalibration,
    known: SelfCalibration | None, tell: Progress,
) -> Reconstruction:  # fmt: skip
    """Every mode but imu."""
    uses_sensors = mode in ("sf2", "rtof") and recording.imus is not None
    if not uses_sensors and not isinstance(calibrate, SelfCalibration):
        calibrate = False
    choices = Choices.of(calibrate, known, lifter)
    known = None if known is None else known.for_another_recording()
    told = recording
    with explained(told, skeleton or told.skeleton, lifter):
        found, slipped, warnings = _as_told(calibrate, known, recording, skeleton, lifter, settings, tell)
        if found is not None:
            recording = found.apply(recording)
            skeleton = None if found.of_kind("bones") else skeleton
        skeleton = skeleton or recording.skeleton
        fragment = on_floor(settings.solver(skeleton, found is not None), recording.floor_height, found)
        settings = settings.with_fragment(fragment)
        prepared = prepare(recording, skeleton, mode, lifter, settings, tell, slipped)
        keypoints, poses, solution = _solved(prepared, skeleton, mode, settings, tell, found)
        if (
            mode == "rtof" and settings.guard_streams and prepared.bone_imus is not None
            and (wrong := disagreeing(poses, prepared.bone_imus, skeleton))
        ):  # fmt: skip
            wrong = joined((*slipped, *wrong))
            prepared = prepare(recording, skeleton, mode, lifter, settings, tell, wrong)
            keypoints, poses, solution = _solved(prepared, skeleton, mode, settings, tell, found)
    warnings += _doubts(prepared, solution, settings)
    disagree = any(fault.kind is FaultKind.DISAGREES for fault in prepared.faults)
    doubted = mode == "rtof" and settings.guard_streams and bool(warnings or disagree)
    of_camera = check_camera_evidence(told, prepared, poses, skeleton, lifter)
    view_doubted = any(check.failed for check in of_camera)
    checks = (
        *check_sensor_evidence(told, prepared, skeleton, lifter, settings, doubted, view_doubted),
        *of_camera,
    )
    failed = (check.message for check in checks if check.failed)
    _warn(recording, (*failed, *prepared.faults, *warnings))
    motion = _told(skeleton.motion(poses), keypoints, prepared, solution)
    stages = prepared.stages | {mode: motion.poses if mode != "lift" else poses}
    scores = stage_metrics(stages, recording.truth, skeleton, mode)
    return Reconstruction(
        recording, mode, motion, stages, keypoints, prepared.bone_imus, solution, scores.get(mode), scores,
        faults=prepared.faults, warnings=warnings, calibration=found, checks=checks,
        choices=choices.with_settings(settings, mode),
    )  # fmt: skip


def _warn(recording: Recording, sentences: Iterable[object]) -> None:
    for sentence in sentences:
        logging.getLogger(DOUBTS).warning("%s: %s", recording.name, sentence)


def _as_told(
    calibrate: bool | CalibrationPriors | SelfCalibration, known: SelfCalibration | None,
    recording: Recording, skeleton: SkeletonModel | None, lifter: LifterLike | None,
    settings: ReconstructionSettings, tell: Progress,
) -> tuple[SelfCalibration | None, tuple[StreamFault, ...], tuple[str, ...]]:  # fmt: skip
    """What is known of a recording with what it says of itself, what was not listened to for that, and
    warnings.
    """
    if calibrate is False:
        return known, (), ()
    if isinstance(calibrate, SelfCalibration):
        return (calibrate if known is None else known.followed_by(calibrate)), (), ()
    priors = None if calibrate is True else calibrate
    try:
        found, slipped = _calibrated(recording, skeleton, priors, known, lifter, settings, tell)
    except CalibrationError as error:
        if priors is not None:
            raise
        reason = f"not calibrated from the recording, which is taken as it is given: {error}"
        return known, (), (reason,)
    return found, slipped, consistency_warnings(recording, found)


def _doubts(
    prepared: Prepared, solution: FragmentSolution | None, settings: ReconstructionSettings
) -> tuple[str, ...]:
    """What makes one doubt a motion: silent sensors, and joints far from where they were seen."""
    found: tuple[str, ...] = ()
    if prepared.bone_imus is not None and not np.isfinite(prepared.bone_imus.R_world_bone).any():
        found += (
            "no sensor says anything at the times of the video: what comes out is of the image alone; "
            "look at the sensors' values and clock",
        )
    s = settings.fragment
    if solution is not None and isinstance(s, JointSpaceSettings) and s.sigma_reprojection is None:
        limit = s.sigma_reprojection_range[1]
        found += misfits(solution.fragments, prepared.start.times, settings.frames, limit)
    return found


def _told(
    motion: MotionSequence, keypoints: KeypointSequence, prepared: Prepared, solution: FragmentSolution | None
) -> MotionSequence:
    """A motion with how well it is known, where the solver says so: what lasts is added."""
    if solution is None or solution.confidence is None:
        return motion
    sensors = () if prepared.bone_imus is None else prepared.bone_imus.joints
    told = residual_statistics(keypoints, motion, prepared.stages["lift"], sensors)
    start = prepared.stages.get("sf2", prepared.stages["lift"])
    apart = disagreement(motion.poses, start, solution.confidence.pairs)
    return replace(motion, confidence=CovarianceInflation.shipped().apply(solution.confidence, told, apart))


def _solved(
    prepared: Prepared, skeleton: SkeletonModel, mode: str, settings: ReconstructionSettings, tell: Progress,
    found: SelfCalibration | None,
) -> tuple[KeypointSequence, PoseSequence, FragmentSolution | None]:  # fmt: skip
    """The keypoints as used, the mode's poses, and what the fragment solver reports where it is used.

    Args:
        settings: with those of the fragment solver.
    """
    keypoints = prepared.recording.video
    if found is not None:
        keypoints = found.moved(keypoints, prepared.start)
    if mode not in ("rto", "rtof"):
        return keypoints, prepared.stages[mode], None
    places = None  # in Cartesian space all that usually carry one
    if isinstance(settings.fragment, JointSpaceSettings):
        places = sensor_places(prepared.recording, skeleton, settings)
    solution = FragmentSolver(skeleton, settings.frames, settings.fragment, places).solve(
        prepared.start, keypoints, prepared.bone_imus, lambda i, n: tell(mode, i, n),
        confidence=settings.confidence,
    )  # fmt: skip
    return keypoints, solution.poses, solution


def calibrate_recording(
    recording: Recording,
    skeleton: SkeletonModel | None = None,
    priors: CalibrationPriors | None = None,
    *,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    progress: Progress | None = None,
) -> SelfCalibration:
    """Estimate what is not known well about a recording from itself; see `rtof_kin.calibration.estimate`.

    Args:
        recording: with IMUs and their calibration, however rough.
        skeleton: the subject's; from the recording where not given.
        priors: what is open, and how well it is known before; `CalibrationPriors.of` the recording where
            not given.
        lifter, settings, progress: as for `reconstruct`.

    Raises:
        CalibrationError: there is nothing to calibrate by. Errors of the stages pass through.
    """
    if recording.imus is None:
        raise CalibrationError(
            f"recording {recording.name}: has no IMUs, without which there is nothing to calibrate by; "
            "add them, or reconstruct it as it is with mode 'rto'"
        )
    settings = settings or ReconstructionSettings()
    tell = progress or (lambda stage, done, total: None)
    return _calibrated(recording, skeleton, priors, None, lifter, settings, tell)[0]


def _calibrated(
    recording: Recording, skeleton: SkeletonModel | None, priors: CalibrationPriors | None,
    known: SelfCalibration | None, lifter: LifterLike | None, settings: ReconstructionSettings,
    tell: Progress,
) -> tuple[SelfCalibration, tuple[StreamFault, ...]]:  # fmt: skip
    """What is known of a recording with what it says of itself, and what was not listened to for that."""
    check_height(recording)
    if skeleton is not None:
        recording = replace(recording, joint_offsets=skeleton.joint_offsets, height=None, bone_lengths=None)
    recording = recording if known is None else known.apply(recording)
    priors = priors or CalibrationPriors.of(recording)
    prepared = prepare(recording, recording.skeleton, "sf2", lifter, settings, tell)
    fragment = on_floor(settings.solver(recording.skeleton), recording.floor_height, known)
    solver = fragment if isinstance(fragment, JointSpaceSettings) else None
    if known is not None:
        keypoints = known.moved(prepared.recording.video, prepared.start)
        prepared = replace(prepared, recording=replace(prepared.recording, keypoints=keypoints))
        if known.ankle_height:
            priors = replace(priors, sigma_ankle_height=None)
    slipped = _slipped(prepared, recording.skeleton, settings.with_fragment(fragment))
    sensors = None if prepared.bone_imus is None else without(prepared.bone_imus, slipped)
    guess = initial_guess(
        prepared.start, prepared.recording.video, sensors, recording.skeleton,
        refit_root=solver is None or solver.refit_root,
    )  # fmt: skip
    found = calibrate_from(
        prepared.recording, guess, priors, solver, settings.frames,
        lambda done, total: tell("calibrate", done, total), slipped,
    )  # fmt: skip
    return (found if known is None else known.followed_by(found)), slipped


def _slipped(
    prepared: Prepared, skeleton: SkeletonModel, settings: ReconstructionSettings
) -> tuple[StreamFault, ...]:
    """Sensors that differ from the motion solved with all of them, but not all the time: what they say of
    their mounting is no constant.
    """
    if not settings.guard_streams or prepared.bone_imus is None:
        return ()
    plain = replace(settings, confidence=False)
    _, poses, _ = _solved(prepared, skeleton, "rtof", plain, lambda *_: None, None)
    most = _LASTING_SHARE * (poses.times[-1] - poses.times[0])
    wrong = disagreeing(poses, prepared.bone_imus, skeleton)
    return tuple(fault for fault in wrong if fault.stop - fault.start < most)


def _without_camera(
    recording: Recording, skeleton: SkeletonModel, settings: ReconstructionSettings, tell: Progress
) -> Reconstruction:
    """Mode imu."""
    if settings.space == "cartesian" or isinstance(settings.fragment, CartesianSettings):
        raise ShapeError("mode imu is solved in joint space; leave out the other space and its settings")
    solver = settings.fragment or replace(settings, space="joint").solver(skeleton)
    assert isinstance(solver, JointSpaceSettings)
    settings = settings.with_fragment(solver)
    cleaned, faults = guarded(recording, settings, camera=False)
    found = reconstruct_from_sensors(
        cleaned, skeleton, settings.sensors_alone, solver, settings.frames, settings.sensor_joints,
        lambda done, total: tell("imu", done, total),
    )  # fmt: skip
    checks = check_sensor_form(recording)
    failed = (check.message for check in checks if check.failed)
    _warn(recording, (*failed, *faults, *found.warnings))
    motion = skeleton.motion(found.solution.poses)
    stages = {"start": found.start, "imu": motion.poses}
    scores = stage_metrics(stages, recording.truth, skeleton, "imu")
    return Reconstruction(
        recording, "imu", motion, stages, None, found.bone_imus, found.solution, scores.get("imu"),
        scores, found.path.sigma, faults, found.warnings,
        choices=Choices().with_settings(settings, "imu"), checks=checks,
    )  # fmt: skip
