"""From a recording to a motion: the paper's three stages, or inertial sensors alone."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from operator import call
from typing import Any

from rtof_kin.body.skeleton import SkeletonModel
from rtof_kin.calibration.camera_estimate import CameraEstimate
from rtof_kin.calibration.priors import CalibrationPriors
from rtof_kin.calibration.result import SelfCalibration
from rtof_kin.core.choices import Mode
from rtof_kin.core.environment import RESULT_WARNINGS
from rtof_kin.core.errors import RtofError
from rtof_kin.core.jobs import side_by_side
from rtof_kin.data.camera import Camera
from rtof_kin.data.imu_stream import FaultKind, StreamFault
from rtof_kin.data.poses import PoseSequence
from rtof_kin.inertial.outlier_rejection import find_disagreements
from rtof_kin.reconstruction import checks
from rtof_kin.reconstruction.certificate import certify
from rtof_kin.reconstruction.checks.position import PositionErrors
from rtof_kin.reconstruction.lift import LifterLike
from rtof_kin.reconstruction.prepare import Job, Prepared, Progress, silent
from rtof_kin.reconstruction.quality import quality_warnings, with_covariances
from rtof_kin.reconstruction.result import Reconstruction
from rtof_kin.reconstruction.self_calibration import SetupEstimate, find_camera, with_camera
from rtof_kin.reconstruction.sensors_alone import reconstruct_from_sensors
from rtof_kin.reconstruction.settings import ReconstructionSettings
from rtof_kin.recording.recording import Recording
from rtof_kin.solve.solution import FragmentSolution
from rtof_kin.solve.uncertainty import leg_misfit


def reconstruct(
    recording: Recording,
    skeleton: SkeletonModel | None = None,
    mode: Mode | None = None,
    *,
    lifter: LifterLike | None = None,
    settings: ReconstructionSettings | None = None,
    calibrate: bool = False,
    priors: CalibrationPriors | None = None,
    calibration: SelfCalibration | None = None,
    known: SelfCalibration | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Reconstruct the motion of a recording; one of more than two minutes in parts, see `reconstruction.parts`.

    The video is lifted once, and once more where the recording is calibrated first. The result is in memory as a
    whole: `reconstruct_in_parts` with the same arguments yields it part by part, as `export` writes it.

    >>> from rtof_kin import Recording, reconstruct
    >>> recording = Recording.load("recording")
    >>> result = reconstruct(recording, mode="sf2")
    >>> len(result.motion.q), result.motion.skeleton.names[0]
    (60, 'Hips')

    Args:
        recording: keypoints of one camera or several and, for sf2 and rtof, IMUs with their calibration; mode
            imu needs the IMUs only.
        skeleton: the subject's. Default: that of the recording.
        mode: lift, sf2, rto, rtof or imu (`rtof_kin.core.choices.Mode`). Default: the one that uses all that
            was recorded.
        lifter: keypoints to 3D, and a pose prior if it has one. Default: the shipped one, loaded only now.
        settings: of SF2, the fragment solver and mode imu.
        calibrate: calibrate the recording from itself first, in the modes that use sensors, against gross
            errors of delay, mounting and bones (docs/calibration.md). Where it is impossible, a warning says
            why, and an error if `priors` are given.
        priors: of that calibration. Default: `CalibrationPriors.of` the recording.
        calibration: an earlier result of `calibrate_recording` for this recording; it is applied and
            nothing is estimated.
        known: the calibration of another recording of the same person; what holds for the person
            (`SelfCalibration.for_another_recording`) is applied and no longer estimated.
        progress: called with (stage, steps done, steps in all).

    Raises:
        UnknownNameError: no such mode. InvalidInputError: the mode needs keypoints or IMUs that the
            recording does not have. ViewError: the person is behind the camera. Errors of the stages.
    """
    from rtof_kin.reconstruction.part_results import joined
    from rtof_kin.reconstruction.parts import reconstruct_in_parts  # which runs each part by `run`

    parts = reconstruct_in_parts(
        recording,
        skeleton,
        mode,
        lifter=lifter,
        settings=settings,
        calibrate=calibrate,
        priors=priors,
        calibration=calibration,
        known=known,
        progress=progress,
    )
    return joined(tuple(parts))


@contextmanager
def explaining(job: Job) -> Iterator[None]:
    """Raise errors of a job with the likely cause that a check of its recording finds."""
    try:
        yield
    except RtofError as error:
        explained = checks.explained(error, job.recording, job.subject, job.lifter)
        if explained is None:
            raise
        raise explained from error


def run(job: Job, mode: Mode, setup: SetupEstimate) -> Reconstruction:
    """Solve the motion of a recording that was set up; see `reconstruct` for errors."""
    with explaining(job):
        if mode == "imu":
            found = reconstruct_from_sensors(job)
            if job.settings.certificate:
                found = replace(found, certificate=certify(job, mode, found.motion))
        else:
            found = _from_video(job, mode, setup)
    failed = (check.message for check in found.checks if check.failed)
    for sentence in (*failed, *found.faults, *found.warnings):
        logging.getLogger(RESULT_WARNINGS).warning("%s: %s", job.recording.name, sentence)
    return found


def _from_video(job: Job, mode: Mode, setup: SetupEstimate) -> Reconstruction:
    """Solve every mode but imu, and check the motion against the recording."""
    clocks, camera, calibration = setup.clocks, setup.camera, setup.calibration
    declared = setup.corrected(job)
    job = declared.calibrated(calibration)
    prepared, poses, solution = _optimised(job, mode, calibration, clocks.left_out(job))
    skeleton, settings, recording = prepared.skeleton, job.settings, job.recording
    left_out = (other.warning for other in prepared.others if other.doubt)
    warnings = (*setup.warnings, *left_out, *quality_warnings(prepared, solution, settings))
    disagree = any(fault.kind is FaultKind.DISAGREES for fault in prepared.faults)
    suspect = mode == "rtof" and "motion" in settings.guards and bool(warnings or disagree)
    motion = skeleton.motion(poses)
    legs = None if solution is None else leg_misfit(prepared.recording.video, motion)
    others, tasks = list[PoseSequence](), list[Callable[[], Any]]()
    if settings.checks:
        checked = partial(checks.run, suspect=suspect, belonging=clocks.checks, legs=legs)
        tasks.append(partial(checked, declared.recording, prepared, poses, job.lifter))
    if solution is not None and solution.confidence is not None:
        others += clocks.apart(poses) if job.sensed(mode) else ()
        again = partial(_solved_with, replace(job, progress=silent), mode, prepared.rejected, calibration)
        tasks += [partial(again, one) for one in (camera.deviations() if camera is not None else ())]
    results = list(side_by_side(call, tasks))
    found, position = results.pop(0) if settings.checks else ((), PositionErrors.declared(declared.recording))
    others += results
    motion, position = with_covariances(motion, prepared, solution, others, position, legs)
    stages = prepared.stages | {mode: motion.poses if mode != "lift" else poses}
    certificate = certify(job, mode, motion, prepared.rejected, calibration) if settings.certificate else None
    if calibration is not None and clocks.applied is not None:
        calibration = calibration.after(clocks.applied)
    return Reconstruction(
        recording,
        mode,
        motion,
        stages,
        prepared.recording.video,
        prepared.bone_imus,
        solution,
        faults=prepared.faults,
        warnings=warnings,
        calibration=calibration,
        delay=clocks.delay,
        camera=camera,
        checks=found,
        certificate=certificate,
        choices=replace(setup.choices, settings=settings if solution is not None else settings.with_fragment(None)),
        position_errors=position,
        lifts=prepared.others,
    )


def _solved_with(
    job: Job, mode: Mode, rejected: tuple[StreamFault, ...], calibration: SelfCalibration | None, camera: Camera
) -> PoseSequence:
    """Solve with another camera."""
    return job.solved_again(with_camera(job.recording, camera), mode, rejected, calibration)[1]


def _optimised(
    job: Job, mode: Mode, calibration: SelfCalibration | None, rejected: tuple[StreamFault, ...]
) -> tuple[Prepared, PoseSequence, FragmentSolution | None]:
    """Prepare and solve; once more without the sensors that contradict the motion."""
    prepared = job.prepare(mode, rejected, calibration)
    if mode not in ("rto", "rtof"):
        return prepared, prepared.stages[mode], None
    solution = job.solve(prepared, job.settings.confidence, mode)
    if mode == "rtof" and "motion" in job.settings.guards and prepared.bone_imus is not None:
        wrong = find_disagreements(solution.poses, prepared.bone_imus, prepared.skeleton)
        if wrong:
            prepared = prepared.without(wrong)
            solution = job.solve(prepared, job.settings.confidence, mode)
    return prepared, solution.poses, solution


def calibrate_camera(
    recording: Recording, *, lifter: LifterLike | None = None, progress: Progress | None = None
) -> CameraEstimate:
    """Find an uncalibrated camera by the image alone; see `rtof_kin.reconstruction.self_calibration`. `ViewError`: the
    person is behind the camera. Errors of the stages.
    """
    job = Job.of(recording, None, lifter, None, progress)
    with explaining(job):
        return find_camera(job, "lift")
